"""Stage ``patch_memory``: memory of the patch-wise gradient, as conf/experiment/patch_memory.yaml says."""

from __future__ import annotations

import time
from dataclasses import dataclass

from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.patch_memory import PatchMemory
from neural_sim.report.patch_memory import report_patch_memory
from neural_sim.stages.temperatures import frozen_loop
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class PatchMemoryStep(PatchMemory):
    """See :class:`PatchMemory`."""

    def run(self, context: Context) -> None:
        """Measure at the initial psi and the warm-started detector; to the run's folder and MLflow.

        Raises:
            ValueError: an estimator that does not differentiate the renderer.
        """
        x, begun = context.experiment, time.time()
        if not isinstance(x.loop.gradient, PathwiseEstimator):
            raise ValueError(
                "patch_memory: want gradient=pathwise, no other estimator differentiates the renderer"
            )
        rows = self.measure(frozen_loop(context, x.run.seed), x.loop.gradient, x.run.seed)
        camera, field = context.graph.camera, type(context.results(context.graph.fields[0]).field).__name__
        setting = f"{field}, {camera.width} x {camera.height} pixels, {x.imaging.renderer.rays_per_chunk} rays a chunk"
        run = report_patch_memory(
            rows, setting, x.run.name, x.run.seed, x.config, context.uri, context.folder, begun
        )
        print(f"results: {context.folder}\n{run.where}")

"""Stage ``interpolation``: images between two lights, as conf/experiment/illumination_interpolation.yaml says."""

from __future__ import annotations

import time
from dataclasses import dataclass

from neural_sim.report.interpolation import Interpolation, report_interpolation
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class InterpolationStep(Interpolation):
    """See :class:`Interpolation`."""

    def run(self, context: Context) -> None:
        """The figure, and how little opacity changed, to the run's folder and MLflow.

        Raises:
            ValueError: a light that is fixed.
        """
        x, begun = context.experiment, time.time()
        views = x.imaging.views
        if views.rig is None:
            raise ValueError("interpolation: want renderer=nerf_w, the light is fixed")
        scene = context.results(context.graph.scene)
        fields = dict(zip(scene.names, scene.fields, strict=True))
        interpolated = self.interpolated_views(
            fields, scene.lit_renderer, views.camera(self.image_size), views.rig.anchors
        )
        title = "From light {} to light {}".format(*self.ends)
        run = report_interpolation(
            interpolated, title, x.run.name, x.config, context.uri, context.folder, begun
        )
        print(f"results: {context.folder}\n{run.where}")

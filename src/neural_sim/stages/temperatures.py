"""Stage ``temperatures``: bias and variance of relaxed draws, as conf/experiment/gumbel_temperature.yaml says."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.frozen import FrozenLoop
from neural_sim.outer.temperatures import Temperatures
from neural_sim.report.temperatures import report_temperatures
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class TemperaturesStep(Temperatures):
    """See :class:`Temperatures`."""

    def run(self, context: Context) -> None:
        """Measure at the initial psi and the warm-started detector; to the run's folder and MLflow.

        Raises:
            ValueError: an estimator that does not relax its draws, or photographs among the training images.
        """
        x, begun = context.experiment, time.time()
        if not isinstance(x.loop.gradient, PathwiseEstimator):
            raise ValueError("temperatures: want gradient=pathwise, no other estimator relaxes its draws")
        if x.training.real.combined:
            raise ValueError(
                "temperatures: want training.real.mode=none, their problem has synthesised images only"
            )
        loop, images = frozen_loop(context, x.run.seed), x.loop.outer.images_per_object
        rows, truths = self.measure(loop, x.loop.gradient, images, x.run.seed)
        named = x.run.name, x.run.seed, x.config
        run = report_temperatures(rows, truths, *named, context.uri, context.folder, begun)
        print(f"v {loop.solve}; {time.time() - begun:.0f} s\nresults: {context.folder}\n{run.where}")


def frozen_loop(context: Context, seed: int) -> FrozenLoop:
    """The psi loop frozen at its start: images of the initial psi, the warm-started detector, the solved v."""
    graph, results, generator = context.graph, context.results, torch.Generator().manual_seed(seed)
    psi, scene = graph.psi("initial"), results(graph.scene)
    images = context.experiment.loop.outer.images_per_object
    drawn = scene.training_set(psi, images, generator).images
    theta, validation = results(graph.warm_start).params, results(graph.targets).val
    detector, solver = graph.warm_start.build(), context.experiment.loop.solver
    return FrozenLoop.at(scene, detector, theta, psi, drawn, validation, solver, generator)

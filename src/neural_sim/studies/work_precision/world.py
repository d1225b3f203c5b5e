"""Inputs of the families of measurements: fields, detector and psi loop of a run, from the store or made on demand."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from neural_sim.field.base import RadianceField
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.graph import Psi
from neural_sim.studies.frozen import FrozenLoop
from neural_sim.studies.work_precision.series import Series, Timing
from neural_sim.tasks.context import Context
from neural_sim.tasks.report import run_results
from neural_sim.types import PosedViews


@dataclass(frozen=True)
class World:
    """The parts of a run, each made on first use."""

    context: Context

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the objects."""
        return self.context.graph.names

    @property
    def fields(self) -> Sequence[RadianceField]:
        """A fitted field of every object."""
        return [self.context.results(stage).field for stage in self.context.graph.fields]

    @property
    def views(self) -> PosedViews:
        """Views of the first object, the held-out ones last."""
        return self.context.results(self.context.graph.views[0])

    @property
    def held_out(self) -> int:
        """The number of held-out views."""
        return self.context.experiment.imaging.views.held_out

    @property
    def renderer(self) -> NerfRenderer:
        """The renderer of the run."""
        return self.context.experiment.imaging.renderer

    @property
    def loop(self) -> FrozenLoop:
        """The psi loop at its start, with v solved by the run's solver."""
        return FrozenLoop.of(self.context, self.context.experiment.run.seed)

    @property
    def outer(self) -> Outer:
        """The psi loop's settings."""
        return self.context.experiment.loop.outer

    @property
    def uri(self) -> str:
        """The MLflow store's address."""
        return self.context.uri

    @property
    def results(self) -> Mapping[str, Any]:
        """The content of the run's own results.json, after its psi loop and evaluation."""
        graph, results = self.context.graph, self.context.results
        scores = {name: results(stage) for name, stage in graph.compared(results(graph.learned)).items()}
        return run_results(self.context, scores, symmetric=False).document()

    @property
    def visited(self) -> Mapping[str, Psi]:
        """Psi after the first step that moved it, and at the end of the loop; empty if no step moved it."""
        trajectory = self.context.results(self.context.graph.learned).trajectory
        moved = [psi for psi in trajectory if not torch.equal(psi, trajectory[0])]
        return {"first_step": moved[0], "end": trajectory[-1]} if moved else {}

    def simulator(
        self, outer: Outer, solver: AdjointSolver, seed: int, psi: Psi | None = None
    ) -> SimulatorModule:
        """Return the psi loop, not yet run, with other settings and starting from another ``psi``.

        Raises:
            ValueError: the method does not follow the hypergradient.
        """
        stage = self.context.graph.learned
        if stage.parts is None:
            raise ValueError(
                f"work_precision: want a method that follows the hypergradient, got {stage.method.name}"
            )
        parts = dataclasses.replace(stage.parts, solver=solver)
        initial = stage.initial if psi is None else psi
        other = dataclasses.replace(stage, outer=outer, parts=parts, seed=seed, initial=initial)
        loop = other.loop(self.context.results)
        if not isinstance(loop, SimulatorModule):
            raise ValueError(f"work_precision: want a loop with a derivative, got {type(loop).__name__}")
        return loop


class Family(Protocol):
    """One family of measurements."""

    def measure(self, world: World, timing: Timing, seed: int) -> Iterable[Series]:
        """Measure one series after another."""
        ...

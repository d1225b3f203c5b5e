"""Stage ``work_precision``: error against run time, as conf/experiment/work_precision.yaml says."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from typing_extensions import override

from neural_sim.field.base import RadianceField
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.report.provenance import machine
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Stage
from neural_sim.studies.frozen import FrozenLoop
from neural_sim.studies.work_precision.derivative import Derivative
from neural_sim.studies.work_precision.estimator import Estimators
from neural_sim.studies.work_precision.field import Fields
from neural_sim.studies.work_precision.hypergradient import Hypergradients
from neural_sim.studies.work_precision.loop import Loops
from neural_sim.studies.work_precision.quadrature import Quadrature
from neural_sim.studies.work_precision.renderer import Renderer
from neural_sim.studies.work_precision.report import document, track, write, write_docs
from neural_sim.studies.work_precision.series import Clock, Series, Timing
from neural_sim.studies.work_precision.solver import Solver
from neural_sim.studies.work_precision.suite import Family, WorkPrecision
from neural_sim.tasks.context import Context, Task
from neural_sim.tasks.report import run_results
from neural_sim.types import PosedViews

_log = logging.getLogger(__name__)
FAMILIES = ("quadrature", "renderer", "field", "solver", "hypergradient", "estimator", "derivative", "loop")
"""In the order of the loop; each is a key of the stage's settings."""
COMMAND = "python -m src.main +experiment=work_precision"
"""What a documentation page says that makes its sections; they are to be made at its scale, quick."""
READS: Mapping[str, Callable[[Graph], Iterable[Stage[Any]]]] = {
    "renderer": lambda graph: graph.fields,
    "field": lambda graph: graph.views,
    "hypergradient": lambda graph: [graph.warm_start, graph.targets],
    "estimator": lambda graph: [graph.warm_start, graph.targets],
    "derivative": lambda graph: graph.fields,
    "loop": lambda graph: [graph.learned, graph.targets],
}
"""The stages that a family reads."""


@dataclass(frozen=True)
class RunWorld:
    """A run's own fields, detector and psi loop, from its store or made when they are first asked for."""

    context: Context

    @property
    def names(self) -> tuple[str, ...]:
        return self.context.graph.names

    @property
    def fields(self) -> Sequence[RadianceField]:
        return [self.context.results(stage).field for stage in self.context.graph.fields]

    @property
    def views(self) -> PosedViews:
        return self.context.results(self.context.graph.views[0])

    @property
    def held_out(self) -> int:
        return self.context.experiment.imaging.views.held_out

    @property
    def renderer(self) -> NerfRenderer:
        return self.context.experiment.imaging.renderer

    @property
    def loop(self) -> FrozenLoop:
        return FrozenLoop.of(self.context, self.context.experiment.run.seed)

    @property
    def outer(self) -> Outer:
        return self.context.experiment.loop.outer

    @property
    def uri(self) -> str:
        return self.context.uri

    @property
    def results(self) -> Mapping[str, Any]:
        graph, results = self.context.graph, self.context.results
        scores = {name: results(stage) for name, stage in graph.compared(results(graph.learned)).items()}
        return run_results(self.context, scores, symmetric=False).document()

    def simulator(self, outer: Outer, solver: AdjointSolver, seed: int) -> SimulatorModule:
        """The psi loop. Raises ``ValueError`` for a method that does not follow the hypergradient."""
        stage = self.context.graph.learned
        if stage.parts is None:
            raise ValueError(
                f"work_precision: want a method that follows the hypergradient, got {stage.method.name}"
            )
        parts = dataclasses.replace(stage.parts, solver=solver)
        loop = dataclasses.replace(stage, outer=outer, parts=parts, seed=seed).loop(self.context.results)
        if not isinstance(loop, SimulatorModule):
            raise ValueError(f"work_precision: want a loop with a derivative, got {type(loop).__name__}")
        return loop


@dataclass(frozen=True)
class WorkPrecisionStep(Task):
    """``+experiment=work_precision``.

    Args:
        families: which of the other keys are measured, in this order.
        repeats: runs whose median time counts.
        clock: ``cpu_seconds``, processor time, or ``seconds``, on the wall.
        docs: a Markdown page whose sections on the measured families are rewritten; null: none.

    Raises:
        ValueError: an unknown family or clock, or fewer than one repeat.
    """

    families: Sequence[str] = FAMILIES
    repeats: int = 3
    clock: Clock = "cpu_seconds"
    docs: str | None = None
    quadrature: Quadrature = field(default_factory=Quadrature)
    renderer: Renderer = field(default_factory=Renderer)
    fits: Fields = field(default_factory=Fields)
    solver: Solver = field(default_factory=Solver)
    hypergradient: Hypergradients = field(default_factory=Hypergradients)
    estimator: Estimators = field(default_factory=Estimators)
    derivative: Derivative = field(default_factory=Derivative)
    loop: Loops = field(default_factory=Loops)

    def __post_init__(self) -> None:
        _ = self.suite  # raises for families and the clock

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        return [stage for name in self.families if name in READS for stage in READS[name](context.graph)]

    @property
    def suite(self) -> WorkPrecision:
        settings: dict[str, Family] = {
            name: getattr(self, "fits" if name == "field" else name) for name in FAMILIES
        }
        return WorkPrecision(self.families, settings, Timing(self.repeats, self.clock))

    def run(self, context: Context) -> None:
        """Every family to the run's folder and to MLflow, and to the page ``docs``."""
        config, begun, found = context.config, time.time(), list[Series]()
        clock = {"last": time.perf_counter()}

        def told(name: str) -> None:
            _log.info("work_precision: %s (%.1f s so far)", name, time.perf_counter() - clock["last"])

        for each in self.suite.measure(RunWorld(context), config["seed"], told):
            found.append(each)
            for mine, other in each.overtaken():
                _log.warning("%s: the default %s is not Pareto-optimal: %s has an error of %.2g in place of %.2g in "
                             "%.2g s in place of %.2g", each.name, mine.setting, other.setting, other.error,
                             mine.error, other.seconds, mine.seconds)  # fmt: skip
        held = document(found, machine(), [])
        print(write(found, held, context.folder))
        if self.docs is not None:
            write_docs(held, Path(self.docs), COMMAND)
        run = track(found, config, context.uri, context.folder, begun)
        print(f"{time.time() - begun:.0f} s\nresults: {context.folder}\n{run.where}")

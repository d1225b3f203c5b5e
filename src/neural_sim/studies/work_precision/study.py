"""``+experiment=work_precision``: error against run time, the evidence behind the defaults, family by family."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from annotated_types import MinLen
from typing_extensions import override

from neural_sim.ranges import Distinct, PositiveInt, validated
from neural_sim.report.provenance import machine
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Stage
from neural_sim.studies.frozen_loop import check_comparable
from neural_sim.studies.work_precision.estimator import Estimators
from neural_sim.studies.work_precision.field import Fields
from neural_sim.studies.work_precision.hypergradient import Hypergradients
from neural_sim.studies.work_precision.measurement import Clock, Family, Series, Timing, World
from neural_sim.studies.work_precision.quadrature import Quadrature
from neural_sim.studies.work_precision.report import document, publish, write_docs
from neural_sim.studies.work_precision.solver import Solver
from neural_sim.tasks.context import Context, Task

_log = logging.getLogger(__name__)
Name = Literal["quadrature", "field", "solver", "hypergradient", "estimator"]
FAMILIES: tuple[Name, ...] = get_args(Name)
"""Families in the order of the psi loop."""
COMMAND = "python -m src.main +experiment=work_precision"
"""Command shown in the sections of a documentation page, which are made at the scale ``quick``."""
READS: Mapping[str, Callable[[Graph], Iterable[Stage[Any]]]] = {
    "field": lambda graph: graph.views,
    "hypergradient": lambda graph: [graph.warm_start, graph.targets],
    "estimator": lambda graph: [graph.warm_start, graph.targets],
}
"""Stages that families read."""


@validated
@dataclass(frozen=True)
class WorkPrecision(Task):
    """``+experiment=work_precision``: measure error against run time, family by family.

    Args:
        families: the families to measure, in this order.
        repeats: number of timings; their median is reported.
        clock: ``cpu_seconds`` of CPU time, or ``seconds`` of wall-clock time.
        docs: a Markdown page whose sections on the measured families are rewritten; null: none.
        quadrature: settings of the family of this name.
        fits: settings of the family ``field``.
        solver: settings of the family of this name.
        hypergradient: settings of the family of this name.
        estimator: settings of the family of this name.
    """

    families: Annotated[Sequence[Name], MinLen(1), Distinct()] = FAMILIES
    repeats: PositiveInt = 3
    clock: Clock = "cpu_seconds"
    docs: str | None = None
    quadrature: Quadrature = field(default_factory=Quadrature)
    fits: Fields = field(default_factory=Fields)
    solver: Solver = field(default_factory=Solver)
    hypergradient: Hypergradients = field(default_factory=Hypergradients)
    estimator: Estimators = field(default_factory=Estimators)

    @property
    def timing(self) -> Timing:
        """How run times are measured."""
        return Timing(self.repeats, self.clock)

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        if "estimator" in self.families:
            check_comparable(context, "work_precision.estimator")
        if "hypergradient" in self.families and graph.learned.parts is None:
            method = graph.learned.method.name
            raise ValueError(
                f"work_precision.hypergradient: want a method that follows it, got baseline={method}"
            )
        if "field" in self.families and graph.views[0].held_out == 0:
            raise ValueError("work_precision.families: field wants views.held_out of at least 1, got 0")
        stages = [stage for name in self.families if name in READS for stage in READS[name](graph)]
        later = "hypergradient" in self.families and self.hypergradient.after_start
        return [*stages, graph.learned] if later else stages

    @override
    def run(self, context: Context) -> None:
        found = []
        for each in self.measure(World(context), context.config["seed"]):
            found.append(each)
            for mine, other in each.overtaken():
                _log.warning("%s: the default %s is not Pareto-optimal: %s has an error of %.2g in place of %.2g in "
                             "%.2g s in place of %.2g", each.name, mine.setting, other.setting, other.error,
                             mine.error, other.seconds, mine.seconds)  # fmt: skip
        held = document(found, machine())
        publish(context, found, held)
        if self.docs is not None:  # last, since a page that cannot be written must not lose what was measured
            write_docs(held, Path(self.docs), COMMAND)

    def measure(self, world: World, seed: int) -> Iterator[Series]:
        """Measure every series of every family, one after another."""
        begun = time.perf_counter()
        for name in self.families:
            _log.info("work_precision: %s (%.1f s so far)", name, time.perf_counter() - begun)
            family: Family = getattr(self, "fits" if name == "field" else name)
            yield from family.measure(world, self.timing, seed)

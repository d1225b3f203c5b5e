"""What every family of measurements reads and yields.

It reads the fields, the detector and the psi loop of a run, and yields series: settings of one computation with their
errors and run times, some of which are Pareto-optimal.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import torch

from neural_sim.devices import peak_bytes, synchronise
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.ranges import PositiveInt, validated
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.graph import Psi
from neural_sim.studies.frozen_loop import FrozenLoop
from neural_sim.tasks.context import Context
from neural_sim.types import PosedViews

T = TypeVar("T")
Clock = Literal["cpu_seconds", "seconds"]
"""CPU time of all threads, which other work on the machine hardly affects, or wall-clock time."""
CLEARLY = 0.9
"""A setting beats a default if it takes at most this fraction of its time; timings vary by a few percent."""
RECORDED = 0.1
"""Seconds of the longest run whose memory is measured; recording the allocations of longer ones takes gigabytes."""
SHORTEST = 0.05
"""Seconds of the shortest measurement; shorter runs are repeated to fill it."""


@dataclass(frozen=True)
class Point:
    """One setting.

    Attributes:
        setting: its name.
        error: nonnegative error, of the kind that the series names.
        seconds: run time by the clock of the series.
        memory_mb: peak memory of tensors in MiB; None if it was not measured.
        default: whether it is the default setting.
        line: name of its line in the figure; a line joins settings that differ in one number.
        detail: further text for the table.
    """

    setting: str
    error: float
    seconds: float
    memory_mb: float | None = None
    default: bool = False
    line: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Order:
    """The observed order of convergence of one ``line``: the least-squares slope of log error over log step.

    ``theory`` is the expected order; ``steps`` says over which steps the slope was taken.
    """

    line: str
    observed: float
    theory: float
    steps: str


@dataclass(frozen=True)
class Series:
    """Settings of one computation whose errors and run times can be compared.

    ``name`` starts with the family and a slash. ``note`` says what was measured, and what it was compared with.

    Raises:
        ValueError: there is no point, two have the same setting, or an error or a time is negative.
    """

    name: str
    error_kind: str
    points: tuple[Point, ...]
    orders: tuple[Order, ...] = ()
    note: str = ""
    clock: Clock = "cpu_seconds"

    def __post_init__(self) -> None:
        names = [point.setting for point in self.points]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"{self.name}: want settings that differ, got {names}")
        wrong = [point for point in self.points if point.error < 0.0 or point.seconds < 0.0]
        if wrong:
            raise ValueError(f"{self.name}: want errors and seconds of at least 0, got {wrong}")

    @property
    def family(self) -> str:
        """The part of the name before the slash."""
        return self.name.partition("/")[0]

    @property
    def pareto(self) -> tuple[bool, ...]:
        """Whether each point is Pareto-optimal, see ``pareto``."""
        return pareto([(point.error, point.seconds) for point in self.points])

    def overtaken(self) -> Iterator[tuple[Point, Point]]:
        """Yield every default that is beaten, with the fastest setting that beats it.

        A setting beats the default if its error is not larger and its time is shorter by more than the noise of
        timings, see ``CLEARLY``.
        """
        for mine in self.points:
            ahead = [o for o in self.points if o.error <= mine.error and o.seconds <= CLEARLY * mine.seconds]
            if mine.default and ahead:
                yield mine, min(ahead, key=lambda other: other.seconds)


def pareto(costs: Sequence[tuple[float, float]]) -> tuple[bool, ...]:
    """Return which pairs are optimal: no other pair is at most as large in both numbers and smaller in one.

    A pair with NaN or infinity is never optimal, and other pairs are optimal regardless of it.
    """
    usable = [all(math.isfinite(value) for value in pair) for pair in costs]
    return tuple(
        fine
        and not any(
            good and _dominates(other, pair) for other, good in zip(costs, usable, strict=True)
        )
        for pair, fine in zip(costs, usable, strict=True)
    )  # fmt: skip


def _dominates(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[0] and one[1] <= other[1] and one != other


def slope(steps: Sequence[float], errors: Sequence[float]) -> float:
    """Return the least-squares slope of log ``errors`` over log ``steps``.

    It is NaN if an error is 0 or not finite, if there are fewer than two errors, or if all steps are equal.

    Raises:
        ValueError: the sequences have different lengths, or a step is not positive.
    """
    if len(steps) != len(errors) or any(step <= 0.0 for step in steps):
        raise ValueError(f"slope: want a positive step for each error, got {list(steps)} and {list(errors)}")
    if len(errors) < 2 or not all(0.0 < error < math.inf for error in errors):
        return math.nan
    x, y = ([math.log(value) for value in values] for values in (steps, errors))
    if len(set(x)) < 2:
        return math.nan
    return statistics.linear_regression(x, y).slope


@validated
@dataclass(frozen=True)
class Timing:
    """How run times are measured: the median of ``repeats`` runs by ``clock``."""

    repeats: PositiveInt = 3
    clock: Clock = "cpu_seconds"

    def now(self, device: torch.device | None = None) -> float:
        """Return the time of the clock in seconds, after the device has finished its work."""
        if device is not None:
            synchronise(device)
        return time.process_time() if self.clock == "cpu_seconds" else time.perf_counter()

    def once(self, run: Callable[[], T], device: torch.device | None = None) -> tuple[float, T]:
        """Return the seconds of a single run, for long computations, and its result."""
        begun = self.now(device)
        value = run()
        return self.now(device) - begun, value

    def of(self, run: Callable[[], object], device: torch.device | None = None) -> tuple[float, float | None]:
        """Return seconds and peak memory (MiB) of ``run``; memory is measured in a separate run that is not timed.

        A run that takes less than ``SHORTEST`` is repeated to fill that time in each of the ``repeats``. Memory is None
        if a run takes longer than ``RECORDED``.
        """
        first = self.once(run, device)[0]
        memory = peak_bytes(run, device) / 2**20 if first < RECORDED else None
        times = math.ceil(SHORTEST / max(first, 1e-5))

        def several() -> None:
            for _ in range(times):
                run()

        return statistics.median(self.once(several, device)[0] / times for _ in range(self.repeats)), memory


@dataclass(frozen=True)
class World:
    """The parts of a run, each made on first use."""

    context: Context

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the objects."""
        return self.context.graph.names

    @property
    def views(self) -> PosedViews:
        """Views of the first object, the held-out ones last."""
        return self.context.results(self.context.graph.views[0])

    @property
    def held_out(self) -> int:
        """The number of held-out views."""
        return self.context.graph.views[0].held_out

    @property
    def loop(self) -> FrozenLoop:
        """The psi loop frozen at its start, with v from the run's solver."""
        return FrozenLoop.of(self.context, self.context.experiment.run.seed)

    @property
    def outer(self) -> Outer:
        """The psi loop's settings."""
        return self.context.experiment.loop.outer

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
        parts = None if stage.parts is None else dataclasses.replace(stage.parts, solver=solver)
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

"""Settings of one computation with their errors and run times, and which of them are Pareto-optimal."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch

from neural_sim.devices import peak_bytes, synchronise
from neural_sim.ranges import PositiveInt, validated

T = TypeVar("T")
Clock = Literal["cpu_seconds", "seconds"]
"""Processor time of all threads, which other work on the machine hardly changes, or time on the wall."""
CLEARLY = 0.9
"""Part of a default's time below which another setting of no larger error beats it: timings vary by some percent."""
RECORDED = 0.1
"""Seconds up to which a run's memory is measured: the record of a longer run's allocations takes gigabytes."""
SHORTEST = 0.05
"""Seconds that a timed run takes at least; shorter ones are repeated within it."""


@dataclass(frozen=True)
class Point:
    """One setting.

    Attributes:
        setting: its name.
        error: at least 0, of the kind that the series names.
        seconds: by the series' clock.
        memory_mb: the most that tensors took at one time in MiB; None where it was not measured.
        default: whether it is the project's own.
        line: the settings that a line in the figure joins (those that differ in one number).
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

    ``name`` begins with its family and a slash. ``note`` says what was measured, against which reference.

    Raises:
        ValueError: no point, two of the same setting, or a negative error or time.
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
        """Yield every default that another setting beats beyond the noise of timings, with the fastest of these.

        That is one of at most its error, in at most ``CLEARLY`` of its time.
        """
        for mine in self.points:
            ahead = [o for o in self.points if o.error <= mine.error and o.seconds <= CLEARLY * mine.seconds]
            if mine.default and ahead:
                yield mine, min(ahead, key=lambda other: other.seconds)


def pareto(costs: Sequence[tuple[float, float]]) -> tuple[bool, ...]:
    """Return which of the pairs no other dominates: is at most as large in both numbers and smaller in one.

    Pairs with a number that is nan or infinite are never optimal and dominate nothing.
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

    It is nan where an error is 0 or there are fewer than two.

    Raises:
        ValueError: sequences of different lengths, or a step that is not positive.
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
        """Return seconds of the clock, after the device's work."""
        if device is not None:
            synchronise(device)
        return time.process_time() if self.clock == "cpu_seconds" else time.perf_counter()

    def once(self, run: Callable[[], T], device: torch.device | None = None) -> tuple[float, T]:
        """Return seconds of one run, for what takes long, and its result."""
        begun = self.now(device)
        value = run()
        return self.now(device) - begun, value

    def of(self, run: Callable[[], object], device: torch.device | None = None) -> tuple[float, float | None]:
        """Return seconds and memory (MiB) of ``run``; the run whose memory is measured does not count for the seconds.

        One that takes less than ``SHORTEST`` is run as often as fills that, which gives its mean. Memory is None for
        one that takes longer than ``RECORDED``.
        """
        first = self.once(run, device)[0]
        memory = peak_bytes(run, device) / 2**20 if first < RECORDED else None
        times = math.ceil(SHORTEST / max(first, 1e-5))

        def several() -> None:
            for _ in range(times):
                run()

        return statistics.median(self.once(several, device)[0] / times for _ in range(self.repeats)), memory

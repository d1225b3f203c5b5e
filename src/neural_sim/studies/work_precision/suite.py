"""The families of measurements and what each of them is given."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from neural_sim.field.base import RadianceField
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.settings import Outer
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.studies.frozen import FrozenLoop
from neural_sim.studies.work_precision.series import Series, Timing
from neural_sim.types import PosedViews


class World(Protocol):
    """What a run makes for the families, each when it is asked for."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the objects."""
        ...

    @property
    def fields(self) -> Sequence[RadianceField]:
        """A fitted field of every object."""
        ...

    @property
    def views(self) -> PosedViews:
        """Of the first object, the held-out ones last."""
        ...

    @property
    def held_out(self) -> int:
        """How many of the views are held out."""
        ...

    @property
    def renderer(self) -> NerfRenderer:
        """The run's own."""
        ...

    @property
    def loop(self) -> FrozenLoop:
        """The psi loop at its start, with v solved by the run's solver."""
        ...

    def simulator(self, outer: Outer, solver: AdjointSolver, seed: int) -> SimulatorModule:
        """The psi loop, not yet run, with other settings."""
        ...

    @property
    def outer(self) -> Outer:
        """The psi loop's own settings."""
        ...

    @property
    def uri(self) -> str:
        """Of the MLflow store."""
        ...

    @property
    def results(self) -> Mapping[str, Any]:
        """The content of the run's own results.json, after its psi loop and evaluation."""
        ...


class Family(Protocol):
    """One family of measurements."""

    def measure(self, world: World, timing: Timing, seed: int) -> Iterable[Series]: ...


@dataclass(frozen=True)
class WorkPrecision:
    """The families that are asked for, in their order.

    Args:
        families: their names, each a key of ``settings``.
        settings: every family.
        timing: how run times are measured.

    Raises:
        ValueError: no family, or one that is unknown.
    """

    families: Sequence[str]
    settings: Mapping[str, Family]
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        if not self.families or not set(self.families) <= set(self.settings):
            raise ValueError(
                f"work_precision.families wants some of {', '.join(self.settings)}, got {list(self.families)}"
            )

    def measure(
        self, world: World, seed: int, told: Callable[[str], object] = lambda name: None
    ) -> Iterator[Series]:
        """Every series of every family; ``told`` hears each family's name before it begins."""
        for name in self.families:
            told(name)
            yield from self.settings[name].measure(world, self.timing, seed)

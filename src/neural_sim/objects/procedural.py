"""The built-in default objects, generated at run time: no downloads, the same bytes for the same seed."""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from annotated_types import MinLen

from neural_sim.objects import household
from neural_sim.objects.mesh import ObjectMesh, normalise
from neural_sim.ranges import Distinct, NonNegativeInt, validated

DESIGNS = {
    "can": household.can,
    "pitcher": household.pitcher,
    "tall_box": household.tall_box,
    "flat_box": household.flat_box,
    "mug": household.mug,
    "drill": household.drill,
}


@validated
class Procedural:
    """Six textured household objects, two blue and four red, without a unit of length.

    Args:
        names: names of the objects; None: all.
        seed: seed of their small print. Shapes and marks are fixed, and no object depends on which others are chosen.

    Raises:
        ValueError: a name is unknown.
    """

    metric: ClassVar[bool] = False

    def __init__(
        self, names: Annotated[list[str], MinLen(1), Distinct()] | None = None, seed: NonNegativeInt = 0
    ) -> None:
        chosen = list(DESIGNS) if names is None else list(names)
        unknown = [name for name in chosen if name not in DESIGNS]
        if unknown:
            raise ValueError(f"objects.names: want some of {', '.join(DESIGNS)}, got {unknown}")
        self._names = chosen
        self.seed = seed

    def names(self) -> list[str]:
        """Return the names of the chosen objects, in their order."""
        return list(self._names)

    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of each object's geometry and texture."""
        return {item.name: item.digest for item in self.load()}

    def load(self) -> list[ObjectMesh]:
        """Make the objects, normalised, in the order of ``names``."""
        order = list(DESIGNS)
        items = []
        for name in self._names:
            generator = torch.Generator().manual_seed(self.seed * len(order) + order.index(name))
            items.append(normalise(DESIGNS[name](generator), name, f"procedural object {name}"))
        return items

"""Held-out error of fields against fitting time, for several numbers of steps."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from neural_sim.field.recipe import FieldRecipe
from neural_sim.ranges import Positive, validated
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World

SCHEDULES = ("refine_steps", "prune_steps")
"""Arguments of a fitting that are numbers of steps, and change in proportion to all steps."""


def scaled(recipe: FieldRecipe, part: float) -> FieldRecipe:
    """Return the recipe with ``part`` times as many steps; its structure changes at proportionally moved steps."""
    fitting = recipe.fitting
    if isinstance(fitting, functools.partial):
        moved = {
            key: [max(1, round(part * step)) for step in fitting.keywords[key]]
            for key in SCHEDULES
            if key in fitting.keywords
        }
        fitting = functools.partial(fitting.func, *fitting.args, **{**fitting.keywords, **moved})
    return replace(recipe, steps=max(1, round(part * recipe.steps)), fitting=fitting)


@validated
@dataclass(frozen=True)
class Fields:
    """The family ``field``.

    Args:
        recipes: recipes of fields, by name.
        parts: numbers of steps as multiples of each recipe's own, by the same names.
        default: the default among ``recipes``, with all of its steps.

    Raises:
        ValueError: the names of ``recipes`` and ``parts`` differ, or the default is not among them.
    """

    recipes: Mapping[str, FieldRecipe] = field(default_factory=dict)
    parts: Mapping[str, Sequence[Positive]] = field(default_factory=dict)
    default: str = "grid"

    def __post_init__(self) -> None:
        if set(self.recipes) != set(self.parts) or (self.recipes and self.default not in self.recipes):
            raise ValueError(
                f"work_precision.field: want parts for each of {sorted(self.recipes)} and one of them as default, got "
                f"{sorted(self.parts)} and {self.default!r}"
            )

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Fit the run's first object, and take wall-clock seconds of training, without the renders that score it."""
        del timing, seed  # a fit records its own time, and its recipe has its own seed
        views, points = world.views, []
        for name, recipe in self.recipes.items():
            for part in self.parts[name]:
                one = scaled(recipe, part)
                score = one.fit(views, world.held_out, views.images.device)[1][-1]
                error, own = 10.0 ** (-score["psnr"] / 20.0), name == self.default and part == 1.0
                detail = f"{score['psnr']:.1f} dB"
                points.append(
                    Point(f"{name}, {one.steps} steps", error, score["seconds"], None, own, name, detail)
                )
        if points:
            height, width = views.images.shape[1:3]
            note = (
                f"{world.names[0]}, {len(views) - world.held_out} views of {width} x {height} pixels, scored on "
                f"{world.held_out} others. Every row is a fit of its own, whose schedule has that number of steps. "
                "Wall-clock seconds."
            )
            yield Series("field/held-out views", "root mean square error of held-out pixels", tuple(points), (), note,
                         "seconds")  # fmt: skip

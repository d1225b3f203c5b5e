"""How images depend on psi: which numbers of a draw depend on it, and the camera's derivatives with respect to each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.parameter.factor import COORDINATES
from neural_sim.types import SceneDraw

RIGID = ("phi", "rho", "distance")
"""The coordinates that place the camera; the fourth coordinate, the magnification, does not."""
SHRINK = (-1.0, -1.0, 0.0, 0.0)
"""Relative change of a pose's columns that has the effect of a relative change of the focal length."""


def moved_by(relaxed: Callable[[Float[Tensor, "K"]], SceneDraw], psi: Float[Tensor, "K"]) -> tuple[str, ...]:
    """Name the draw's numbers that depend on psi; the others need no tangent."""
    with torch.enable_grad():
        draw = relaxed(psi.detach().requires_grad_())
    values = {name: getattr(draw, name) for name in COORDINATES}
    return tuple(name for name, value in values.items() if value is not None and value.requires_grad)


def light_names(count: int) -> tuple[str, ...]:
    """Name the weights of a draw's lights, by which derivatives are taken."""
    return tuple(f"weights_{i}" for i in range(count))


def number_of(draw: SceneDraw, name: str) -> Float[Tensor, "n"]:
    """Return one number of every draw by its name: a coordinate, or the weight of a light."""
    if name.startswith("weights_") and draw.weights is not None:
        return draw.weights[:, int(name.removeprefix("weights_"))]
    return getattr(draw, name)


def pose_rates(draw: SceneDraw, names: Sequence[str]) -> Float[Tensor, "m n 4 4"]:
    """Differentiate every image's camera-to-world matrix by each of its draw's ``names``.

    The matrix maps a pixel's direction into the world. A focal length m divides that direction's x and y by m, as a
    matrix with shorter axes would: d(x/m)/dm = -(x/m)/m. This also changes the direction's length, which ``ray_rates``
    corrects.

    Raises:
        ValueError: ``names`` is empty, or has one that is not a coordinate of the draw.
    """
    drawn = {name: getattr(draw, name) for name in COORDINATES if getattr(draw, name) is not None}
    if not names or set(names) - set(drawn):
        raise ValueError(
            f"pose_rates: want names of the draw's coordinates ({', '.join(drawn)}), got {tuple(names)}"
        )
    numbers = {name: drawn[name].detach() for name in RIGID}
    zeros = {name: torch.zeros_like(number) for name, number in numbers.items()}

    def rate(name: str) -> Float[Tensor, "n 4 4"]:
        if name == "magnification":
            shrink = torch.tensor(SHRINK).to(numbers["phi"]) / drawn[name].detach()[:, None, None]
            return cameras.orbit(**numbers, radius=draw.radius) * shrink
        unit = {**zeros, name: torch.ones_like(numbers[name])}
        return torch.func.jvp(lambda moved: cameras.orbit(**moved, radius=draw.radius), (numbers,), (unit,))[
            1
        ]

    return torch.stack([rate(name) for name in names])

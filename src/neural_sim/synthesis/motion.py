"""How psi moves images: which numbers of a draw depend on it, and how the camera follows each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.parameter.product import COORDINATES
from neural_sim.types import SceneDraw

RIGID = ("phi", "rho", "distance")
"""The coordinates that place the camera; the fourth, the magnification, leaves it where it is."""


def moved_by(relaxed: Callable[[Float[Tensor, "K"]], SceneDraw], psi: Float[Tensor, "K"]) -> tuple[str, ...]:
    """Names of the draw's numbers that depend on psi; the others need no tangent."""
    with torch.enable_grad():
        draw = relaxed(psi.detach().requires_grad_())
    values = {name: getattr(draw, name) for name in COORDINATES}
    return tuple(name for name, value in values.items() if value is not None and value.requires_grad)


def light_names(count: int) -> tuple[str, ...]:
    """Names of the derivatives by each weight of a draw's light."""
    return tuple(f"weights_{i}" for i in range(count))


def number_of(draw: SceneDraw, name: str) -> Float[Tensor, "n"]:
    """One number of every draw by its name, a coordinate's or that of a light's weight."""
    if name.startswith("weights_") and draw.weights is not None:
        return draw.weights[:, int(name.removeprefix("weights_"))]
    return getattr(draw, name)


def pose_rates(draw: SceneDraw, names: Sequence[str]) -> Float[Tensor, "m n 4 4"]:
    """Derivatives of every image's camera-to-world pose by each of its draw's ``names``.

    Raises:
        ValueError: no name, or one that does not place the camera.
    """
    if not names or set(names) - set(RIGID):
        raise ValueError(f"pose_rates: want names among {RIGID}, got {tuple(names)}")
    numbers = {name: getattr(draw, name).detach() for name in RIGID}
    still = {name: torch.zeros_like(number) for name, number in numbers.items()}
    rates = [
        torch.func.jvp(
            lambda moved: cameras.orbit(**moved),
            (numbers,),
            ({**still, name: torch.ones_like(numbers[name])},),
        )[1]
        for name in names
    ]
    return torch.stack(rates)

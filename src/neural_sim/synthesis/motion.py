"""How psi moves images: which numbers of a draw depend on it, and how the camera follows each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.types import SceneDraw

CONTINUOUS = ("phi", "rho", "distance")
"""The numbers of a ``SceneDraw`` that images depend on smoothly."""


def moved_by(relaxed: Callable[[Float[Tensor, "k"]], SceneDraw], psi: Float[Tensor, "k"]) -> tuple[str, ...]:
    """Names of the draw's numbers that depend on psi; the others need no tangent."""
    with torch.enable_grad():
        draw = relaxed(psi.detach().requires_grad_())
    return tuple(name for name in CONTINUOUS if getattr(draw, name).requires_grad)


def pose_rates(draw: SceneDraw, names: Sequence[str]) -> Float[Tensor, "m n 4 4"]:
    """Derivatives of every image's camera-to-world pose by each of its draw's ``names``.

    Raises:
        ValueError: no name, or one that is not a continuous number of the draw.
    """
    if not names or set(names) - set(CONTINUOUS):
        raise ValueError(f"pose_rates: want names among {CONTINUOUS}, got {tuple(names)}")
    numbers = {name: getattr(draw, name).detach() for name in CONTINUOUS}
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

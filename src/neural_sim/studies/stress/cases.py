"""Parts that all cases share: their inputs and outputs, solids of constant density, and a small detector."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.field.grid import EMPTY_DENSITY, GridField
from neural_sim.field.mlp import MLPField
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.types import Rays

FALSE_ALARM = 1e-9
"""Largest probability with which a statistical check fails although the code is right."""
DOUBLE, SINGLE = torch.float64, torch.float32


@dataclass(frozen=True)
class Scope:
    """Input of every case: the seed of its random problems, and whether heavy ones run at full size.

    Tolerances are valid for every seed; a statistical check fails with a probability below ``FALSE_ALARM``.
    """

    seed: int = 0
    full: bool = True

    def generator(self) -> torch.Generator:
        """Return a new generator, the same for every call."""
        return torch.Generator().manual_seed(self.seed)

    def normal(self, *shape: int) -> Tensor:
        """Draw standard normal numbers in float64, the same for every call."""
        return torch.randn(*shape, generator=self.generator(), dtype=DOUBLE)


@dataclass(frozen=True)
class Check:
    """One number compared with its bound: passes if ``value <= tolerance`` and the status is a wanted one.

    ``value`` is an error (0 is perfect; NaN never passes), ``tolerance`` the error that theory allows, and ``wanted``
    the correct statuses (empty: the quantity has none). The suite adds the case and the ``seconds`` that it took.
    """

    quantity: str
    value: float
    tolerance: float
    status: str = ""
    wanted: tuple[str, ...] = ()
    case: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """True if the value and the status are right."""
        return self.value <= self.tolerance and (not self.wanted or self.status in self.wanted)

    @property
    def used(self) -> float:
        """Fraction of the tolerance that the value uses up; above 1 the check has failed, infinite for NaN."""
        if self.value == 0.0:
            return 0.0
        return math.inf if math.isnan(self.value) or self.tolerance <= 0.0 else self.value / self.tolerance

    def record(self) -> dict[str, Any]:
        """Return the check as JSON; undefined numbers are null."""
        values = {key: value for key, value in asdict(self).items() if key != "wanted"}
        numbers = {key: None for key in ("value", "tolerance") if not math.isfinite(values[key])}
        return {**values, **numbers, "passed": self.passed}


Checks = Iterator[Check]
CASES: dict[str, Callable[[Scope], Checks]] = {}
"""Cases by ``family/name``, in the order of definition."""


def case(function: Callable[[Scope], Checks]) -> Callable[[Scope], Checks]:
    """Register a case by the names of its file and its function."""
    CASES[f"{function.__module__.rsplit('.', 1)[-1]}/{function.__name__}"] = function
    return function


def eps(dtype: torch.dtype) -> float:
    """Return the spacing of the numbers above 1; the unit roundoff is half of it."""
    return torch.finfo(dtype).eps


def worst(*tensors: Tensor) -> float:
    """Return the largest absolute value of any entry; NaN if there is a NaN."""
    return max((float(tensor.detach().abs().max()) for tensor in tensors), key=lambda v: (math.isnan(v), v))


def not_finite(*tensors: Tensor) -> float:
    """Count the entries that are NaN or infinite."""
    return float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


def short(dtype: torch.dtype) -> str:
    """Return the name of a dtype without its module."""
    return str(dtype).removeprefix("torch.")


# --- subjects ---

EXACT = NerfRenderer(termination=0.0)


def raw_density(sigma: float, cell: float) -> float:
    """Return the table entry whose softplus, divided by the edge of a cell, is ``sigma``."""
    depth = sigma * cell
    return depth + math.log(-math.expm1(-depth)) if depth > 0.0 else EMPTY_DENSITY


def block(
    sigma: float, dtype: torch.dtype = SINGLE, half: float = 1.0, cells: int = 8, step_cells: float = 1.0,
    colour: float = 0.0, hollow: bool = False,
) -> GridField:  # fmt: skip
    """Make a cube of constant density around the origin; with ``hollow``, only its outermost cells are filled."""
    field = GridField(step_cells=step_cells, density_gain=1.0).to(dtype)
    occupied = torch.ones(cells, cells, cells, dtype=torch.bool)
    if hollow:
        occupied[1:-1, 1:-1, 1:-1] = False
    cell = 2.0 * half / cells
    field.reset(occupied, torch.full((3,), -half, dtype=dtype), cell)
    with torch.no_grad():
        field.table[:-1, 0] = raw_density(sigma, cell)
        field.table[:-1, 1:] = colour
    return field.eval().requires_grad_(False)


def ball(sigma: float, dtype: torch.dtype = SINGLE) -> MLPField:
    """Make a network with zero weights, which gives constant density in the unit sphere."""
    scale = 1.0 if sigma == 0.0 else sigma
    field = MLPField(
        width=4, depth=2, position_frequencies=1, direction_frequencies=1, density_scale=scale
    ).to(dtype)
    with torch.no_grad():
        for name, value in field.named_parameters():
            value.zero_()
            if name.endswith("sigma.bias"):
                value.fill_(EMPTY_DENSITY if sigma == 0.0 else math.log(math.expm1(1.0)))
    return field.eval().requires_grad_(False)


def chord(rays: Rays, half: float) -> Tensor:
    """Return the length of each ray inside the cube [-half, half]^3, by its six planes, in float64."""
    origins, directions = rays.origins.double(), rays.directions.double()
    inside = origins.abs() < half
    with torch.no_grad():
        low, high = (-half - origins) / directions, (half - origins) / directions
        near, far = torch.minimum(low, high), torch.maximum(low, high)
        parallel = directions == 0.0
        near = torch.where(parallel, torch.where(inside, -math.inf, math.inf), near)
        far = torch.where(parallel, torch.where(inside, math.inf, -math.inf), far)
    return (far.amin(-1) - near.amax(-1).clamp_min(0.0)).clamp_min(0.0)


def opacity_of(depth: Tensor | float) -> Tensor:
    """Return the opacity for an optical depth, by the Beer-Lambert law."""
    return -torch.expm1(-torch.as_tensor(depth, dtype=DOUBLE).clamp_min(0.0))


def outside(opacity: Tensor, sigma: float, shortest: Tensor, longest: Tensor) -> float:
    """Return by how much opacities leave the range of lengths from ``shortest`` to ``longest``; 0 if they do not."""
    low, high = opacity_of(sigma * shortest), opacity_of(sigma * longest)
    return float(torch.maximum(low - opacity.double(), opacity.double() - high).clamp_min(0.0).max())


def rounding_of(sigma: float, dtype: torch.dtype, cell: float = 0.25) -> float:
    """Return a bound on the rounding error of an opacity, from the table entry and the sum over samples of a ray."""
    return (abs(raw_density(sigma, cell)) + 32) * eps(dtype) if sigma else 0.0


def running_sum(samples: int, depth: float) -> float:
    """Return a bound on the rounding error of a running sum of optical depths over all samples of a pack."""
    return samples * eps(DOUBLE) * (min(depth, 50.0 * samples) + samples)


def along_x(*offsets: tuple[float, float], dtype: torch.dtype = SINGLE, start: float = 3.0) -> Rays:
    """Make rays along -x from ``start``, at the given y and z."""
    origins = torch.tensor([[start, y, z] for y, z in offsets], dtype=dtype)
    directions = torch.tensor([[-1.0, 0.0, 0.0]], dtype=dtype).expand(len(offsets), 3)
    return Rays(origins, directions.contiguous())


def small_detector(num_classes: int) -> RetinaNet:
    """Make a RetinaNet for images of 32 x 32 pixels."""
    return RetinaNet(num_classes, 32, anchors=Anchors(sizes=((10,), (18,)), reference=32), head=Head(8, 1))

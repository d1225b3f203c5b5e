"""Error of the volume rendering quadrature by samples per ray, for smooth, sharp and thin densities.

Theory for a step h: the midpoint rule is of second order if density and colour are smooth (Davis and Rabinowitz,
Methods of Numerical Integration), and of first order if the density jumps, since a jump at a random place in a cell
misplaces up to h/2 of the density. One random sample per interval makes 1/h independent errors of size h^2, whose root
mean square is of order 3/2 (Haber 1966); at a jump, it is of first order, too. A shell thinner than the step is either
hit or missed, so there is no order until the step resolves it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge, MinLen
from jaxtyping import Float
from torch import Tensor

from neural_sim.field.quadrature import PackedSamples, composite
from neural_sim.ranges import Ascending, validated
from neural_sim.studies.work_precision.measurement import Order, Point, Series, Timing, slope

SPAN = 2.0
"""Length of every ray in object radii: the diameter of the unit sphere."""
FINER = 16
"""Number of samples of the reference, as a multiple of the finest setting's."""
AT_ONCE = 1 << 18
"""Number of reference samples composited at a time."""
WIDE, THICKNESS = 0.6, 0.02
"""Thickness of the sharp box and of the thin shell in object radii, the mean over rays."""
DEPTH = 1.0
"""Optical depth of both, the mean over rays."""
RULES = ("midpoint", "jittered")
AtLeastTwo = Annotated[int, Ge(2)]

Along = Float[Tensor, "rays samples"]


@dataclass(frozen=True)
class Density:
    """A density along rays at distances from 0 to ``SPAN``, displaced on each ray by its ``offset`` in [0, 1).

    ``midpoint`` and ``jittered`` are the orders of the two rules in theory, for steps up to ``resolved``.
    """

    sigma: Callable[[Along, Along], Along]
    midpoint: float
    jittered: float
    resolved: float = SPAN

    def order(self, rule: str) -> float:
        """Return the order of a rule in theory."""
        return self.midpoint if rule == "midpoint" else self.jittered


def _blob(distance: Along, offset: Along) -> Along:
    """Return a Gaussian that is nonzero at both ends of the ray, since one that vanishes there converges faster."""
    return 3.0 * torch.exp(-(((distance - 0.9 - 0.2 * offset) / 0.7) ** 2))


def box(
    thickness: float, offset: Float[Tensor, "*rays"]
) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
    """Return where a box of about this thickness starts and ends on each ray.

    Both ends vary independently. With the same thickness on all rays, the errors at the two jumps would cancel for some
    steps and add up for others.
    """
    begin = 0.6 + 0.2 * offset
    return begin, begin + thickness * (0.75 + 0.5 * torch.frac(37.0 * offset))


def _box(thickness: float, depth: float) -> Callable[[Along, Along], Along]:
    def sigma(distance: Along, offset: Along) -> Along:
        begin, end = box(thickness, offset)
        return (depth / thickness) * ((distance > begin) & (distance < end)).to(distance)

    return sigma


DENSITIES = {
    "smooth": Density(_blob, 2.0, 1.5),
    "sharp": Density(_box(WIDE, DEPTH), 1.0, 1.0),
    "thin": Density(_box(THICKNESS, DEPTH), 1.0, 1.0, THICKNESS / 2.0),
}


def colour(distance: Along, offset: Along) -> Float[Tensor, "rays samples 3"]:
    """Return a smooth colour along the ray."""
    phases = torch.tensor([0.0, 1.0, 2.0]).to(distance)
    return 0.5 + 0.4 * torch.sin(3.0 * distance[..., None] + phases + offset[..., None])


def rendered(
    density: Density, offset: Float[Tensor, "rays"], samples: int, generator: torch.Generator | None
) -> Float[Tensor, "rays 4"]:
    """Return colour and opacity of the rays by the project's quadrature.

    Samples are at the middle of their intervals or, with a generator, at random places in them.
    """
    rays, step = len(offset), SPAN / samples
    inside = offset.new_full((rays, samples), 0.5)
    if generator is not None:
        inside = torch.rand(rays, samples, generator=generator, dtype=offset.dtype)
    distance = (torch.arange(samples).to(offset) + inside) * step
    at = offset[:, None].expand_as(distance)
    packed = PackedSamples(
        torch.arange(rays).repeat_interleave(samples), distance.reshape(-1),
        torch.full_like(distance, step).reshape(-1), torch.arange(rays + 1) * samples,
    )  # fmt: skip
    sigma, rgb = density.sigma(distance, at).reshape(-1), colour(distance, at).reshape(-1, 3)
    pixels, opacity = composite(sigma, rgb, packed)
    return torch.cat([pixels, opacity[:, None]], -1)


def reference(density: Density, offset: Float[Tensor, "rays"], samples: int) -> Float[Tensor, "rays 4"]:
    """Return ``rendered`` at the middles of ``samples`` intervals, some rays at a time."""
    parts = offset.split(max(1, AT_ONCE // samples))
    return torch.cat([rendered(density, part, samples, None) for part in parts])


@validated
@dataclass(frozen=True)
class Quadrature:
    """The family ``quadrature``.

    Args:
        samples: numbers of samples per ray, increasing.
        default: the default number, which is one per cell of a grid field along the diameter of the unit sphere.
        rays: number of rays through each density, at random offsets.
    """

    samples: Annotated[tuple[AtLeastTwo, ...], MinLen(2), Ascending(strictly=True)] = (
        16,
        32,
        64,
        128,
        256,
        512,
        1024,
    )
    default: AtLeastTwo = 128
    rays: AtLeastTwo = 256

    @property
    def counts(self) -> list[int]:
        """All numbers of samples, including the default."""
        return sorted({*self.samples, self.default})

    def measure(self, world: object, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure root mean square errors of opacity and of colour over rays, in float64."""
        del world  # this family has its own densities
        for name, density in DENSITIES.items():
            offset = torch.rand(self.rays, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            truth = reference(density, offset, FINER * self.counts[-1])
            found = {rule: self._rule(density, offset, truth, rule, timing, seed) for rule in RULES}
            for place, kind in enumerate(("opacity", "colour")):
                points, orders = [], []
                for rule, rows in found.items():
                    points += [row[place] for row in rows]
                    orders.append(self._order(density, rule, [row[place].error for row in rows]))
                yield Series(
                    f"quadrature/{name}, {kind}", f"root mean square error of {kind}", tuple(points), tuple(orders),
                    f"{self.rays} rays of 2 radii, in float64; compared with {FINER * self.counts[-1]} samples a ray.",
                    timing.clock,
                )  # fmt: skip

    def _rule(
        self, density: Density, offset: Tensor, truth: Tensor, rule: str, timing: Timing, seed: int
    ) -> list[tuple[Point, Point]]:
        rows = []
        for count in self.counts:

            def run(count: int = count) -> Tensor:
                generator = torch.Generator().manual_seed(seed + 1) if rule == "jittered" else None
                return rendered(density, offset, count, generator)

            off, (seconds, memory) = run() - truth, timing.of(run)
            default = rule == "midpoint" and count == self.default
            errors = (off[:, 3].square().mean().sqrt(), off[:, :3].square().mean().sqrt())
            rows.append(tuple(
                Point(f"{rule}, {count}", float(error), seconds, memory, default, rule) for error in errors
            ))  # fmt: skip
        return rows

    def _order(self, density: Density, rule: str, errors: list[float]) -> Order:
        """Fit the order to the finer half of the steps that resolve the density; coarser ones are not asymptotic."""
        steps = [SPAN / count for count in self.counts]
        kept = [(h, error) for h, error in zip(steps, errors, strict=True) if h <= density.resolved]
        kept = kept[len(kept) // 2 :] if len(kept) > 4 else kept
        over = f"{kept[0][0]:.2g} to {kept[-1][0]:.2g} radii" if kept else "none resolves it"
        observed = slope([h for h, _ in kept], [error for _, error in kept])
        return Order(rule, observed, density.order(rule), over)

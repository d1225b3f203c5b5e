"""What steps of psi would bring, to first order, before any is made."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.evidence import Average
from neural_sim.outer.settings import Checks
from neural_sim.outer.steps import by_p, stacked
from neural_sim.outer.trust_region import within
from neural_sim.parameter.product import SceneDistribution


@dataclass(frozen=True)
class Foreseen:
    """The expected fall of L_val by one object and factor, to first order, with standard errors.

    ``by_bin``: when the fraction ``moved`` of the object's images moves to each bin (or light), all others losing it
    in proportion; ``step``: by a step of the loop, along the derivative. ``p_value`` is that of the null that the
    derivative is zero.
    """

    name: str
    factor: str
    p_value: float
    moved: float
    by_bin: tuple[float, ...]
    by_bin_error: tuple[float, ...]
    step: float
    step_error: float


def foresee(loop: GradientLoop, trials: int, moved: float) -> list[Foreseen]:
    """Average the derivative at psi over ``trials`` trainings with new random numbers; psi does not move.

    Raises:
        ValueError: no trial, or a fraction outside (0, 1].
    """
    if trials < 1 or not 0.0 < moved <= 1.0:
        raise ValueError(f"want trials >= 1 and moved in (0, 1], got {trials}, {moved}")
    results = []
    for _ in range(trials):
        results.append(loop.derivative())
        loop.inner.renew()
    return expected(
        results,
        loop.scene.distribution,
        loop.psi.detach(),
        loop.scene.names,
        moved,
        loop.settings.checks,
    )


def expected(
    results: list[Hypergradient],
    distribution: SceneDistribution,
    psi: Float[Tensor, "objects K"],
    names: tuple[str, ...],
    moved: float,
    checks: Checks,
) -> list[Foreseen]:
    """The averages of derivatives at one psi, and steps by ``checks``; other arguments as for :func:`foresee`."""
    parts, found = distribution.split(psi), []
    for factor in distribution.factors:
        own = parts[factor.name]
        p = factor.p_of(own)
        average = Average.zeros(own)
        for result in results:
            gradient, error = (distribution.split(v)[factor.name] for v in stacked(result, names, psi))
            average = average.joined(*by_p(factor, own, gradient, error))
        variance = average.variance
        bins = torch.eye(p.shape[-1], dtype=p.dtype)
        toward = moved * (bins - p[:, None, :])  # [objects, bin moved to, change of p]
        radius = torch.full_like(p[:, 0], checks.radius)
        step = factor.p_of(within(factor, own, average.value, radius, checks.keep)) - p
        gains, spread = _along(toward, average.value[:, None], variance[:, None])
        step_gain, step_spread = _along(step, average.value, variance)
        for i, name in enumerate(names):
            found.append(
                Foreseen(
                    name, factor.name, float(average.p_values[i]), moved, tuple(gains[i].tolist()),
                    tuple(spread[i].tolist()), float(step_gain[i]), float(step_spread[i]),
                )
            )  # fmt: skip
    return found


def _along(change: Tensor, direction: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """The first-order gain of a change of p, and its standard error; components' errors are taken as independent."""
    return (change * direction).sum(-1), (change.square() * variance).sum(-1).sqrt()

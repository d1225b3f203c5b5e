"""Draws from p_psi at extreme settings, and projections onto the simplex, against closed and exact solutions."""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor

from neural_sim.parameter import bins as binned
from neural_sim.parameter.bins import BinNoise
from neural_sim.parameter.distributions import project_simplex, project_sum
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.studies.stress.cases import (
    DOUBLE,
    FALSE_ALARM,
    SINGLE,
    Check,
    Checks,
    Scope,
    case,
    eps,
    not_finite,
    short,
    worst,
)  # fmt: skip

CIRCLE = 2.0 * math.pi
CAP = 0.1
"""Smallest resultant that ``circular_mean`` divides by in its derivative."""


def bernstein(p: Tensor, draws: int, alarm: float) -> Tensor:
    """Return the bound that a frequency's deviation from p exceeds with probability ``alarm`` at most (Bernstein)."""
    logarithm = math.log(2.0 / alarm)
    linear = logarithm / (3.0 * draws)
    return linear + (linear**2 + 2.0 * p * (1.0 - p) * logarithm / draws).sqrt()


@case
def one_hot(scope: Scope) -> Checks:
    """Draw from psi = 1000 on one bin without a floor.

    Its p is exactly 1, log p elsewhere is -1000 up to a few roundings, every draw is from that bin (Gumbel noise spans
    at most 31), and dp/dpsi = p (1 - p) = exp(-1000) underflows to 0.
    """
    scene = SceneDistribution.of([Pose(floor=0.0)])
    (pose,) = scene.binned
    truth = torch.where(torch.arange(8) == 5, 0.0, -1000.0)
    for dtype in (DOUBLE, SINGLE):
        psi = truth.to(dtype) + 1000.0
        yield Check(f"log p, {short(dtype)}", worst(pose.log_probabilities(psi) - truth), 4e3 * eps(dtype))
        noise = scene.draw_noise(2000, scope.generator(), dtype)
        hard, relaxed = scene.hard(psi, noise), scene.relaxed(psi, noise)
        missed = int((hard.bins != 5).sum()) + int((relaxed.bins != 5).sum())
        yield Check(f"draws of another bin, {short(dtype)}", float(missed), 0.0)
        # With one weight of exactly 1, the circular mean is a bin's centre after one sine, cosine and arctangent.
        gap = torch.remainder(relaxed.phi.double() - hard.phi.double() + math.pi, CIRCLE) - math.pi
        yield Check(f"relaxed against hard angle, {short(dtype)}", worst(gap), 8 * eps(dtype) * CIRCLE)
        leaf = psi.clone().requires_grad_()
        (slope,) = torch.autograd.grad(pose.log_probabilities(leaf).exp().square().sum(), leaf)
        yield Check(f"dp/dpsi, {short(dtype)}", worst(slope), 8 * eps(dtype))
    wanted = torch.eye(8, dtype=DOUBLE)[2]
    back = pose.log_probabilities(pose.psi_of(wanted)).exp()
    # psi_of() clamps zeros to 1e-6, which the normalisation distributes.
    yield Check("logits of a one-hot p", worst(back - wanted), 7.1e-6)


@case
def floor(scope: Scope) -> Checks:
    """Compute p for very negative psi, against (1 - k f) softmax(psi) + f.

    The derivative of log p_i is (1 - k f) s_i (1 - s_i) / p_i. Rounding: log_softmax of entries of size up to |psi|
    costs eps |psi| in the exponent, the sum in logaddexp a few eps more. At psi = -800 the derivative is 0 and p is f
    exactly; the sum over k bins is 1 within k roundings.
    """
    count, smallest = 8, 0.005
    for dtype in (DOUBLE, SINGLE):
        for depth in (0.0, 5.0, 20.0, 800.0, 1e6):
            leaf = (-depth * torch.eye(count, dtype=dtype)[3]).requires_grad_()
            softmax = torch.softmax(leaf.detach().double(), -1)
            truth = (1.0 - count * smallest) * softmax + smallest
            log_p = binned.log_probabilities(leaf, smallest)
            p = log_p.detach().double().exp()
            # Rounding of psi in the exponent matters only where the softmax part is not negligible next to the floor.
            bound = (8.0 + min(depth, 30.0)) * eps(dtype)
            label = f"psi = -{depth:g}, {short(dtype)}"
            yield Check(f"p: {label}", worst((p - truth) / truth), bound)
            yield Check(f"sum of p - 1: {label}", abs(float(p.sum()) - 1.0), count * bound)
            (slope,) = torch.autograd.grad(log_p[3], leaf)
            exact = float((1.0 - count * smallest) * softmax[3] * (1.0 - softmax[3]) / truth[3])
            yield Check(f"d log p / dpsi: {label}", abs(float(slope[3]) - exact), 4.0 * bound)


@case
def temperatures(scope: Scope) -> Checks:
    """Relax the same draws at tau from 1e-4 to 1e3.

    Compared with the float64 softmax of the same numbers, float32 rounds G + log p and its quotient by tau, each by
    2 eps |z| in the exponent, so the relative error of y is at most exp(4 eps max|z|) - 1. As tau falls,
    1 - max y <= (k - 1) exp(-gap / tau); as it rises, |y - 1 / k| <= (exp(range / tau) - 1) / k. The derivative
    (diag y - y y^T) / tau has no entry above 1 / (4 tau).
    """
    count, draws = 8, 500
    log_p = torch.log_softmax(scope.normal(count), -1)
    noise = binned.gumbel((draws, count), scope.generator(), DOUBLE)
    ordered = (noise + log_p).sort(-1, descending=True).values
    largest = worst(ordered)
    for temperature in (1e-4, 1e-2, 0.1, 1.0, 10.0, 1e3):
        label = f"tau = {temperature:g}"
        y = binned.gumbel_softmax(log_p, noise, temperature)
        slack = math.expm1(8 * eps(DOUBLE) * largest / temperature) + count * eps(DOUBLE)
        yield Check(f"sum of y - 1: {label}", worst(y.sum(-1) - 1.0), count * eps(DOUBLE))
        cold = (count - 1) * torch.exp((ordered[:, 1] - ordered[:, 0]) / temperature)
        yield Check(
            f"1 - max y beyond the cold limit: {label}", float((1.0 - y.amax(-1) - cold).max()), slack
        )
        warm = torch.expm1((ordered[:, 0] - ordered[:, -1]) / temperature) / count
        excess = float(((y - 1.0 / count).abs().amax(-1) - warm).max())
        yield Check(f"|y - 1/k| beyond the warm limit: {label}", excess, slack)
        single = binned.gumbel_softmax(log_p.float(), noise.float(), temperature)
        same = binned.gumbel_softmax(log_p.float().double(), noise.float().double(), temperature)
        # y is at most 1, so a bound above 1 says nothing; the draw's bin is checked by `gumbel_max`.
        bound = min(1.0, math.expm1(min(700.0, 4 * eps(SINGLE) * largest / temperature))) + count * eps(
            SINGLE
        )
        yield Check(f"float32 against float64: {label}", worst(single - same), bound)
        leaf = log_p.clone().requires_grad_()
        row = binned.gumbel_softmax(leaf, noise[:50], temperature)
        slopes = torch.stack([torch.autograd.grad(row[i, 0], leaf, retain_graph=True)[0] for i in range(50)])
        exact = y[:50, :1] * (torch.eye(count, dtype=DOUBLE)[0] - y[:50]) / temperature
        bound = (slack + 8 * eps(DOUBLE)) / temperature
        yield Check(f"dy/dlog p: {label}", worst(slopes - exact), bound)
        yield Check(f"dy/dlog p against its largest: {label}", worst(slopes), 0.25 / temperature + bound)


@case
def gumbel_max(scope: Scope) -> Checks:
    """Compare frequencies of drawn bins with p by Bernstein's inequality, for hard and relaxed draws at every tau.

    The noise is finite in every precision that it is drawn for (float64, float32, float16, bfloat16).
    """
    draws = 200_000 if scope.full else 20_000
    for count in (1, 2, 8, 64):
        (pose,) = Pose(bins=count, floor=0.0 if count == 1 else 0.1 / count).factors
        psi = 2.0 * scope.normal(count)
        p = pose.log_probabilities(psi).exp()
        noise = BinNoise(binned.gumbel((draws, count), scope.generator(), DOUBLE))
        drawn = {"hard": pose.hard(psi, noise)}
        for temperature in (1e-4, 1e3):
            # At tau = 1e3 float64 still tells y apart where the largest two differ by 1e3 eps: ties are below 1e-12.
            y = binned.gumbel_softmax(p.log(), noise.gumbel, temperature)
            drawn[f"tau = {temperature:g}"] = y.argmax(-1)
        for label, bins in drawn.items():
            over = (bins.bincount(minlength=count) / draws - p) / bernstein(p, draws, FALSE_ALARM / count)
            yield Check(f"frequencies over their bounds: k = {count}, {label}", worst(over), 1.0)
    for dtype in (DOUBLE, SINGLE, torch.float16, torch.bfloat16):
        wrong = not_finite(binned.gumbel((1000, 64), scope.generator(), dtype))
        yield Check(f"noise not finite: {short(dtype)}", wrong, 0.0)


@case
def bin_counts(scope: Scope) -> Checks:
    """Draw from 1, 2 and 64 bins: hard draws lie in their bin, up to the rounding of the angle at its very edges."""
    for dtype in (DOUBLE, SINGLE):
        for count in (1, 2, 64):
            scene = SceneDistribution.of([Pose(bins=count, floor=0.0)])
            bins = torch.arange(count).repeat_interleave(4)
            within = torch.tensor([0.0, 0.5, 1.0 - 0.5 * eps(dtype), 1.0], dtype=dtype).repeat(count)
            noise = scene.draw_noise(len(bins), scope.generator(), dtype)
            draw = scene.at_bins({"pose": bins}, SceneNoise(noise.bins, {**noise.uniform, "phi": within}))
            centre = (bins.double() + 0.5) * CIRCLE / count
            outside = float(((draw.phi.double() - centre).abs() - 0.5 * CIRCLE / count).max())
            label = f"k = {count}, {short(dtype)}"
            yield Check(f"angle beyond its bin: {label}", outside, 4 * eps(dtype) * CIRCLE)
            step = (scene.bins_of(draw)[:, 0] - bins).remainder(count)
            wrong = float((step != 0)[within == 0.5].sum())
            yield Check(f"centres in another bin: {label}", wrong, 0.0)
            far = float(((step != 0) & (step != 1) & (step != count - 1)).sum())
            yield Check(f"edges not in a neighbouring bin: {label}", far, 0.0)


@case
def opposite_bins(scope: Scope) -> Checks:
    """Mix two opposite bins, 0.5 + d and 0.5 - d, where the circular mean has no derivative at d = 0: R = 2 d.

    |d angle / dy_i| = R |sin(B_i - angle)| / max(R, cap)^2: at most 1 / cap, and the closed form to the rounding (k +
    8) eps / cap^2.
    """
    count = 8
    angles = (torch.arange(count, dtype=DOUBLE) + 0.5) * CIRCLE / count
    for dtype in (DOUBLE, SINGLE):
        centre = binned.centres(count, 0.0, CIRCLE, torch.zeros(1, dtype=dtype))
        for offset in (0.0, 1e-12, 1e-6, 1e-3, 0.04, 0.06, 0.5):
            y = torch.zeros(1, count, dtype=dtype)
            y[0, 1], y[0, 5] = 0.5 + offset, 0.5 - offset
            length = float(y[0, 1].double() - y[0, 5].double())
            angle = binned.circular_mean(y.requires_grad_(), centre)
            slope = torch.autograd.grad(angle.sum(), y)[0][0].double()
            exact = length * torch.sin(angles - angles[1]) / max(length, CAP) ** 2
            bound = (count + 8) * eps(dtype) / CAP**2
            label = f"offset {offset:g}, {short(dtype)}"
            yield Check(f"d angle / dy: {label}", worst(slope - exact), bound)
            yield Check(f"|d angle / dy| against 1 / cap: {label}", worst(slope), 1.0 / CAP + bound)
            yield Check(f"angles not finite: {label}", not_finite(angle), 0.0)


# --- weights of lights ---


def exact_projection(values: Tensor) -> list[float]:
    """Project one vector without any rounding, from the optimality conditions of the quadratic programme.

    These are ``w = max(v - t, 0)`` with the t that makes the sum 1. The sum falls as t grows, so t is the largest of
    the thresholds given by the m largest entries, over all m.
    """
    entries = [Fraction(float(value)) for value in values]
    ordered = sorted(entries, reverse=True)
    threshold = max((sum(ordered[:m], Fraction(0)) - 1) / m for m in range(1, len(ordered) + 1))
    return [float(max(entry - threshold, Fraction(0))) for entry in entries]


def _extremes(dtype: torch.dtype, noise: Tensor) -> dict[str, Tensor]:
    largest = torch.finfo(dtype).max
    values = {
        "a corner": [1.0, 0.0, 0.0],
        "outside a corner": [3.0, -2.0, 0.1],
        "just off a corner": [1.0 - 1e-6, 1e-6, -1e-6],
        "an edge": [0.5, 0.5, -0.3],
        "all equal": [0.7] * 7,
        "ties at the threshold": [1.0, 0.0, 0.0, 0.0, -1.0],
        "one weight": [-5.0],
        "two huge ties": [1e30, 1e30, -1e30],
        "one huge": [1e30, 1.0, 0.5],
        "huge and negative": [-1e30, -1e30, -1e30, -1e30],
        "the largest numbers": [largest, -largest, 0.0],
        "tiny": [1e-30, -1e-30, 2e-30],
        "near ties at 1e6": [1e6 + 0.25, 1e6, 1e6 - 0.5],
        "64 weights": noise.tolist(),
        "64 stiff weights": (noise * 10.0 ** (noise * 4)).tolist(),
    }
    return {label: torch.tensor(entries, dtype=dtype) for label, entries in values.items()}


@case
def projection(scope: Scope) -> Checks:
    """Project weights of lights, and compare with the exact projection of the same floats in rational arithmetic.

    After clamping, differences from the largest entry are at most 1 and are rounded once (eps / 2). Their sum over k
    entries adds k eps, the threshold and the result one rounding each: (k + 4) eps in all. The weights then sum to
    1 within k times that. The projection onto the plane of sum 1 is v - (mean(v) - 1 / k), whose mean and differences
    round by k eps max|v| each, and k of them are summed.
    """
    for dtype in (DOUBLE, SINGLE):
        for label, values in _extremes(dtype, scope.normal(64)).items():
            weights, count = project_simplex(values), len(values)
            truth = torch.tensor(exact_projection(values), dtype=DOUBLE)
            name, bound = f"{label}, {short(dtype)}", (count + 4) * eps(dtype)
            yield Check(f"error: {name}", worst(weights.double() - truth), bound)
            outside = float(-weights.min().clamp_max(0.0))
            wrong = abs(math.fsum(weights.tolist()) - 1.0) + outside
            yield Check(f"distance to the simplex: {name}", wrong, count * bound)
            wrong = abs(math.fsum(project_sum(values).tolist()) - 1.0)
            largest = max(1.0, worst(values))
            yield Check(f"sum - 1: {name}", wrong, 3 * count * eps(dtype) * largest * count)

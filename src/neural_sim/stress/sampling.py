"""Draws from p_psi at the ends of their settings, against closed forms."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim.parameter import bins as binned
from neural_sim.parameter.factor import BinNoise
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution, SceneNoise
from neural_sim.stress.cases import FALSE_ALARM, Check, Checks, Scope, case, eps

CIRCLE = 2.0 * math.pi
DTYPES = (torch.float64, torch.float32)
CAP = 0.1
"""Smallest resultant that ``circular_mean`` divides by in its derivative."""


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _not_finite(*tensors: Tensor) -> float:
    return float(sum(int((~torch.isfinite(tensor)).sum()) for tensor in tensors))


def _angle_between(a: Tensor, b: Tensor) -> float:
    """Largest difference on the circle, in radians."""
    return float((torch.remainder(a.double() - b.double() + math.pi, CIRCLE) - math.pi).abs().max())


def bernstein(p: Tensor, draws: int, alarm: float) -> Tensor:
    """How far a share of ``draws`` lies from p but with probability ``alarm`` (Bernstein's inequality)."""
    logarithm = math.log(2.0 / alarm)
    linear = logarithm / (3.0 * draws)
    return linear + (linear**2 + 2.0 * p * (1.0 - p) * logarithm / draws).sqrt()


@case
def one_hot(scope: Scope) -> Checks:
    """psi = 1000 on one bin without a floor: p is 1 there to the last bit, log p elsewhere is -1000 to a few
    roundings, every draw is of that bin (Gumbel noise spans 31 at most), and dp/dpsi = p (1 - p) = exp(-1000)
    underflows to 0.
    """
    scene = SceneDistribution.of([Pose(floor=0.0)])
    (pose,) = scene.binned
    for dtype in DTYPES:
        psi = torch.zeros(8, dtype=dtype)
        psi[5] = 1000.0
        log_p = pose.log_probabilities(psi)
        truth = torch.where(torch.arange(8) == 5, 0.0, -1000.0)
        bound = 4 * eps(dtype) * 1000.0
        yield Check(f"log p, {_name(dtype)}", float((log_p - truth).abs().max()), bound)
        noise = scene.draw_noise(2000, scope.generator(), dtype)
        hard, relaxed = scene.hard(psi, noise), scene.relaxed(psi, noise)
        missed = int((hard.bins != 5).sum()) + int((relaxed.bins != 5).sum())
        yield Check(f"draws of another bin, {_name(dtype)}", float(missed), 0.0)
        # One weight of exactly 1: the circular mean is its centre, through one sine, cosine and arctangent.
        gap = _angle_between(relaxed.phi, hard.phi)
        yield Check(f"relaxed against hard angle, {_name(dtype)}", gap, 8 * eps(dtype) * CIRCLE)
        leaf = psi.clone().requires_grad_()
        (slope,) = torch.autograd.grad(pose.log_probabilities(leaf).exp().square().sum(), leaf)
        yield Check(f"dp/dpsi, {_name(dtype)}", float(slope.abs().max()), 8 * eps(dtype))
    back = pose.log_probabilities(pose.psi_of(torch.eye(8, dtype=torch.float64)[2])).exp()
    # logits() raises zeros to 1e-6, which the normalisation shares out
    yield Check("logits of a one-hot p", float((back - torch.eye(8)[2]).abs().max()), 7.1e-6)


@case
def floor(scope: Scope) -> Checks:
    """psi far below: p = (1 - k f) softmax(psi) + f, with its derivative (1 - k f) s_i (1 - s_i) / p_i of log
    p_i.

    Rounding: log_softmax of entries of size up to |psi| costs eps |psi| in the exponent, the sum in logaddexp
    a few eps more. At psi = -800 the derivative is 0 and p is f exactly; the sum over k bins is 1 within k
    roundings.
    """
    count, smallest = 8, 0.005
    for dtype in DTYPES:
        for depth in (0.0, 5.0, 20.0, 800.0, 1e6):
            psi = torch.zeros(count, dtype=dtype)
            psi[3] = -depth
            share = torch.softmax(psi.double(), -1)
            truth = (1.0 - count * smallest) * share + smallest
            leaf = psi.clone().requires_grad_()
            log_p = binned.log_probabilities(leaf, smallest)
            p = log_p.detach().double().exp()
            # An error of psi's rounding in the exponent counts only as far as the softmax part is there.
            bound = (8.0 + min(depth, 30.0)) * eps(dtype)
            label = f"psi = -{depth:g}, {_name(dtype)}"
            yield Check(f"p: {label}", float(((p - truth) / truth).abs().max()), bound)
            yield Check(f"sum of p - 1: {label}", abs(float(p.sum()) - 1.0), count * bound)
            (slope,) = torch.autograd.grad(log_p[3], leaf)
            exact = float((1.0 - count * smallest) * share[3] * (1.0 - share[3]) / truth[3])
            yield Check(f"d log p / dpsi: {label}", abs(float(slope[3]) - exact), 4.0 * bound)


@case
def temperatures(scope: Scope) -> Checks:
    """tau from 1e-4 to 1e3 over the same draws.

    Against the float64 softmax of the same numbers, float32 rounds G + log p and its quotient by tau, 2 eps
    |z| in the exponent each way: y to exp(4 eps max|z|) - 1 relatively. As tau falls 1 - max y <= (k - 1)
    exp(-gap / tau); as it rises |y - 1 / k| <= (exp(range / tau) - 1) / k. The derivative (diag y - y y^T) /
    tau has no entry above 1 / (4 tau).
    """
    count, draws = 8, 500
    log_p = torch.log_softmax(torch.randn(count, generator=scope.generator(), dtype=torch.float64), -1)
    noise = binned.gumbel((draws, count), scope.generator(), torch.float64)
    total = noise + log_p
    ordered = total.sort(-1, descending=True).values
    for temperature in (1e-4, 1e-2, 0.1, 1.0, 10.0, 1e3):
        label = f"tau = {temperature:g}"
        y = binned.gumbel_softmax(log_p, noise, temperature)
        yield Check(
            f"sum of y - 1: {label}", float((y.sum(-1) - 1.0).abs().max()), count * eps(torch.float64)
        )
        rounding = math.expm1(8 * eps(torch.float64) * float(total.abs().max()) / temperature)
        cold = (count - 1) * torch.exp((ordered[:, 1] - ordered[:, 0]) / temperature)
        excess = float((1.0 - y.amax(-1) - cold).clamp_min(0.0).max())
        yield Check(
            f"1 - max y beyond the cold limit: {label}", excess, rounding + count * eps(torch.float64)
        )
        warm = torch.expm1((ordered[:, 0] - ordered[:, -1]) / temperature) / count
        excess = float(((y - 1.0 / count).abs().amax(-1) - warm).clamp_min(0.0).max())
        yield Check(
            f"|y - 1/k| beyond the warm limit: {label}", excess, rounding + count * eps(torch.float64)
        )
        single = binned.gumbel_softmax(log_p.float(), noise.float(), temperature)
        same = binned.gumbel_softmax(log_p.float().double(), noise.float().double(), temperature)
        bound = math.expm1(min(700.0, 4 * eps(torch.float32) * float(total.abs().max()) / temperature))
        value = float((single - same).abs().max())
        # y is at most 1, so an error above 1 says nothing; the draw's bin is checked by `gumbel_max`
        yield Check(f"float32 against float64: {label}", value, min(1.0, bound) + count * eps(torch.float32))
        leaf = log_p.clone().requires_grad_()
        row = binned.gumbel_softmax(leaf, noise[:50], temperature)
        slopes = torch.stack([torch.autograd.grad(row[i, 0], leaf, retain_graph=True)[0] for i in range(50)])
        exact = y[:50, :1] * (torch.eye(count, dtype=torch.float64)[0] - y[:50]) / temperature
        bound = (rounding + 8 * eps(torch.float64)) / temperature
        yield Check(f"dy/dlog p: {label}", float((slopes - exact).abs().max()), bound)
        yield Check(
            f"dy/dlog p against its largest: {label}", float(slopes.abs().max()), 0.25 / temperature + bound
        )


@case
def gumbel_max(scope: Scope) -> Checks:
    """Shares of drawn bins against p, by Bernstein's inequality over all bins, for hard and relaxed draws at
    every tau; the noise is finite where it is drawn for (float64, float32, float16, bfloat16).
    """
    draws = 200_000 if scope.full else 20_000
    for count in (1, 2, 8, 64):
        (pose,) = Pose(bins=count, floor=0.0 if count == 1 else 0.1 / count).factors
        psi = 2.0 * torch.randn(count, generator=scope.generator(), dtype=torch.float64)
        p = pose.log_probabilities(psi).exp()
        noise = BinNoise(binned.gumbel((draws, count), scope.generator(), torch.float64))
        bound = bernstein(p, draws, FALSE_ALARM / count)
        share = pose.hard(psi, noise).bincount(minlength=count) / draws
        yield Check(
            f"shares over their bounds: k = {count}, hard", float(((share - p).abs() / bound).max()), 1.0
        )
        for temperature in (1e-4, 1e3):
            y = binned.gumbel_softmax(p.log(), noise.gumbel, temperature)
            share = y.argmax(-1).bincount(minlength=count) / draws
            # At tau = 1e3 float64 still tells y apart where the largest two differ by 1e3 eps: ties are below 1e-12.
            value = float(((share - p).abs() / bound).max())
            yield Check(f"shares over their bounds: k = {count}, tau = {temperature:g}", value, 1.0)
    for dtype in (torch.float64, torch.float32, torch.float16, torch.bfloat16):
        noise = binned.gumbel((1000, 64), scope.generator(), dtype)
        yield Check(f"noise not finite: {_name(dtype)}", _not_finite(noise), 0.0)


@case
def bin_counts(scope: Scope) -> Checks:
    """k = 1: p = 1, y = 1 and no derivative. k = 64 and k = 1: hard draws lie in their bin, also at its very
    edges.

    An angle at an edge belongs to the bin within the rounding of the angle, 4 eps 2 pi; a miss is by that at
    most.
    """
    for dtype in DTYPES:
        scene = SceneDistribution.of([Pose(bins=1, floor=0.5)])
        psi = torch.tensor([3.0], dtype=dtype, requires_grad=True)
        noise = scene.draw_noise(100, scope.generator(), dtype)
        draw = scene.relaxed(psi, noise)
        (slope,) = torch.autograd.grad(draw.phi.sum(), psi, allow_unused=True, materialize_grads=True)
        yield Check(
            f"log p: k = 1, {_name(dtype)}",
            float(scene.binned[0].log_probabilities(psi.detach()).abs()),
            2 * eps(dtype),
        )
        yield Check(
            f"d angle / dpsi: k = 1, {_name(dtype)}", float(slope.abs()), 100 * 8 * eps(dtype) * math.pi
        )
        for count in (1, 2, 64):
            scene = SceneDistribution.of([Pose(bins=count, floor=0.0)])
            bins = torch.arange(count).repeat_interleave(4)
            last = 1.0 - 0.5 * eps(dtype)
            within = torch.tensor([0.0, 0.5, last, 1.0], dtype=dtype).repeat(count)
            noise = scene.draw_noise(len(bins), scope.generator(), dtype)
            noise = SceneNoise(noise.bins, {**noise.uniform, "phi": within})
            draw = scene.at_bins({"pose": bins}, noise)
            centre = (bins.double() + 0.5) * CIRCLE / count
            outside = (draw.phi.double() - centre).abs() - 0.5 * CIRCLE / count
            label = f"k = {count}, {_name(dtype)}"
            outside = float(outside.clamp_min(0.0).max())
            yield Check(f"angle beyond its bin: {label}", outside, 4 * eps(dtype) * CIRCLE)
            inside = within == 0.5
            found = scene.bins_of(draw)[:, 0]
            wrong = int((found != bins)[inside].sum())
            yield Check(f"centres in another bin: {label}", float(wrong), 0.0)
            step = (found - bins).remainder(count)
            far = int(((step != 0) & (step != 1) & (step != count - 1)).sum())
            yield Check(f"edges not in a neighbouring bin: {label}", float(far), 0.0)


@case
def wrap(scope: Scope) -> Checks:
    """Turning the bins turns the circular mean, and its derivative, whatever bins meet across the wrap.

    The sums of k terms and the arctangent round by (k + 8) eps, which the resultant's length R divides. The
    paper's linear mean of bins 1 and k lands half a circle away, exactly: it is offered, not hidden.
    """
    for dtype in DTYPES:
        for count in (2, 8, 64):
            centre = binned.centres(count, 0.0, CIRCLE, torch.zeros(1, dtype=dtype))
            y = torch.zeros(3, count, dtype=torch.float64)
            y[0, [0, -1]] = torch.tensor([0.6, 0.4], dtype=torch.float64)
            y[1] = torch.softmax(4 * torch.randn(count, generator=scope.generator(), dtype=torch.float64), -1)
            y[2, 0] = 1.0
            y = y.to(dtype)
            length = float(binned.resultant_length(y, centre).min())
            bound = (count + 8) * eps(dtype) * CIRCLE / length
            base = binned.circular_mean(y, centre)
            slope = _mean_slope(y, centre)
            gaps, turned = [0.0], [0.0]
            for shift in range(count):
                rolled = y.roll(shift, -1)
                gaps.append(
                    _angle_between(binned.circular_mean(rolled, centre), base + shift * CIRCLE / count)
                )
                turned.append(float((_mean_slope(rolled, centre) - slope.roll(shift, -1)).abs().max()))
            label = f"k = {count}, {_name(dtype)}"
            yield Check(f"angle over all shifts: {label}", max(gaps), bound)
            # One more division by R, or by the cap, in the derivative.
            yield Check(f"derivative over all shifts: {label}", max(turned), bound / max(length, CAP))
    centre = binned.centres(8, 0.0, CIRCLE, torch.zeros(1, dtype=torch.float64))
    y = torch.zeros(8, dtype=torch.float64)
    y[[0, 7]] = 0.5
    gap = _angle_between(binned.circular_mean(y, centre), torch.tensor(0.0))
    yield Check("circular mean of bins 1 and 8, from 0", gap, 16 * eps(torch.float64) * CIRCLE)
    gap = abs(float(binned.linear_mean(y, centre)) - math.pi)
    yield Check("linear mean of bins 1 and 8, from pi", gap, 16 * eps(torch.float64) * math.pi)


@case
def opposite_bins(scope: Scope) -> Checks:
    """Two opposite bins from 0.5 + d and 0.5 - d, where the circular mean has no derivative at d = 0: R = 2
    d.

    |d angle / dy_i| = R |sin(B_i - angle)| / max(R, cap)^2: at most 1 / cap, and the closed form to the
    rounding (k + 8) eps / cap^2. ``resultant_length`` below the cap is the status that says so.
    """
    count = 8
    for dtype in DTYPES:
        centre = binned.centres(count, 0.0, CIRCLE, torch.zeros(1, dtype=dtype))
        for offset in (0.0, 1e-12, 1e-6, 1e-3, 0.04, 0.06, 0.5):
            y = torch.zeros(1, count, dtype=dtype)
            y[0, 1], y[0, 5] = 0.5 + offset, 0.5 - offset
            slope = _mean_slope(y, centre)[0].double()
            label = f"offset {offset:g}, {_name(dtype)}"
            length = float(y[0, 1].double() - y[0, 5].double())
            angles = (torch.arange(count, dtype=torch.float64) + 0.5) * CIRCLE / count
            exact = length * torch.sin(angles - angles[1]) / max(length, CAP) ** 2
            status = "CAPPED" if float(binned.resultant_length(y, centre)) < CAP else "REGULAR"
            wanted = ("CAPPED",) if length < CAP else ("REGULAR",)
            bound = (count + 8) * eps(dtype) / CAP**2
            yield Check(f"d angle / dy: {label}", float((slope - exact).abs().max()), bound, status, wanted)
            yield Check(
                f"|d angle / dy| against 1 / cap: {label}", float(slope.abs().max()), 1.0 / CAP + bound
            )
            angle = binned.circular_mean(y, centre)
            yield Check(f"angles not finite: {label}", _not_finite(angle), 0.0)


def _mean_slope(y: Tensor, centre: Tensor) -> Tensor:
    leaf = y.detach().clone().requires_grad_()
    return torch.autograd.grad(binned.circular_mean(leaf, centre).sum(), leaf)[0]

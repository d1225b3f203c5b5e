"""Estimators of the mixed derivative at the edges of p and of the scores, and of the boxes' derivative."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim.gradient.reinforce import reinforce
from neural_sim.gradient.significance import no_association, no_difference, zero_mean
from neural_sim.gradient.stratified import allocate, importance_weights, stratified
from neural_sim.parameter import bins as binned
from neural_sim.stress.cases import Check, Checks, Scope, case, eps
from neural_sim.synthesis.boxes import SMALLEST_SLOPE, boxes_from_opacity, subpixel_edges

DOUBLE = torch.float64
BINS, EACH = 8, 4


def _plain(psi: Tensor) -> Tensor:
    return binned.log_probabilities(psi)


def _floored(psi: Tensor) -> Tensor:
    return binned.log_probabilities(psi, 0.005)


def _peaked(depth: float) -> Tensor:
    psi = torch.zeros(BINS, dtype=DOUBLE)
    psi[2] = depth
    return psi


def _not_finite(tensor: Tensor) -> float:
    return float((~torch.isfinite(tensor)).sum())


@case
def constant_scores(scope: Scope) -> Checks:
    """All scores equal: no bin is better, and the derivative is 0 exactly, not the rounding of a sum, which
    an update that takes out the gradient's scale would turn into a full step.
    """
    bins = torch.arange(BINS).repeat_interleave(EACH)
    for value in (1.0, 0.1, -1e8, 1e-300, 1e100):
        scores = torch.full((len(bins),), value, dtype=DOUBLE)
        for label, log_p in (("no floor", _plain), ("floor", _floored)):
            for depth in (0.0, 1.7, 1000.0):
                psi = _peaked(depth)
                found = stratified(scores, bins, psi, log_p)
                name = f"score {value:g}, psi {depth:g}, {label}"
                yield Check(f"stratified: {name}", float(found.value.abs().max()), 0.0)
        found = reinforce(scores, lambda psi: _plain(psi)[bins], _peaked(1.7))
        # Its baseline is a mean of all scores, known to n eps, times a slope of at most 1.
        bound = len(bins) * eps(DOUBLE) * abs(value)
        yield Check(f"reinforce: score {value:g}", float(found.value.abs().max()), bound)


@case
def score_scales(scope: Scope) -> Checks:
    """Scores in another unit, by powers of two: the derivative changes by that, and no digit of it. An offset common to
    all scores changes nothing but by its rounding, n eps of the offset.
    """
    bins = torch.arange(BINS).repeat_interleave(EACH)
    scores = torch.randn(len(bins), generator=scope.generator(), dtype=DOUBLE)
    psi = torch.randn(BINS, generator=scope.generator(), dtype=DOUBLE)
    plain = stratified(scores, bins, psi, _floored)
    p = _floored(psi).exp()
    for power in (-400, -100, 100, 400):
        found = stratified(scores * 2.0**power, bins, psi, _floored)
        change = float((found.value * 2.0**-power - plain.value).abs().max())
        yield Check(f"derivative in units of 2^{power}", change, 0.0)
        change = float((found.standard_error * 2.0**-power - plain.standard_error).abs().max())
        yield Check(f"standard error in units of 2^{power}", change, 0.0)
    for offset in (1e4, 1e12):
        found = stratified(scores + offset, bins, psi, _floored)
        bound = 2 * len(bins) * eps(DOUBLE) * offset * float(p.max())
        yield Check(f"offset of {offset:g}", float((found.value - plain.value).abs().max()), bound)


@case
def significance(scope: Scope) -> Checks:
    """p-values in another unit, by powers of two: no digit changes. Scores that are all equal, one image, one row other
    than zero, numbers that are not finite: 1, nothing is told. Bins of one image each: every permutation has the same
    statistic, and the p-value is 1.
    """
    bins = torch.eye(BINS, dtype=DOUBLE).repeat_interleave(EACH, 0)
    scores = torch.randn(len(bins), generator=scope.generator(), dtype=DOUBLE)
    rows = torch.randn(len(bins), BINS, generator=scope.generator(), dtype=DOUBLE)
    told, tilted = no_association(scores + bins[:, 0], bins), zero_mean(rows + 0.3)
    for power in (-1000, -400, 400, 1000):
        change = abs(no_association((scores + bins[:, 0]) * 2.0**power, bins) - told)
        yield Check(f"association in units of 2^{power}", change, 0.0)
        yield Check(f"mean in units of 2^{power}", abs(zero_mean((rows + 0.3) * 2.0**power) - tilted), 0.0)
    lone = torch.eye(BINS, dtype=DOUBLE)[:, :1] * rows[:1]
    nothing = {
        "equal scores": no_association(torch.full_like(scores, 0.1), bins),
        "one bin drawn": no_association(scores, torch.ones_like(bins)),
        "one image": no_association(scores[:1], bins[:1]),
        "an image a bin": no_association(scores[:BINS], bins[::EACH]),
        "a score of NaN": no_association(scores.clone().index_fill_(0, torch.tensor(0), math.nan), bins),
        "one scene": no_difference(scores[None]),
        "a scene's scores equal under every light": no_difference(scores[:, None].expand(-1, 3)),
        "no rows but zeros": zero_mean(torch.zeros_like(rows)),
        "one row beside zeros": zero_mean(lone),
        "a row of inf": zero_mean(rows.clone().index_fill_(0, torch.tensor(0), math.inf)),
    }
    for name, p_value in nothing.items():
        yield Check(f"p-value below 1: {name}", 1.0 - p_value, 0.0)


@case
def unseen_bins(scope: Scope) -> Checks:
    """All of p on a bin that has no images, and one image in all: finite, and 0 where p is one-hot. The closed form
    p_i (s_i - sum_j p_j s_j) with every bin seen.
    """
    scores = torch.randn(BINS * EACH, generator=scope.generator(), dtype=DOUBLE)
    bins = torch.arange(BINS).repeat_interleave(EACH)
    for depth in (0.0, 20.0, 1000.0):
        psi = _peaked(depth)
        others = bins != 2
        for label, log_p in (("no floor", _plain), ("floor", _floored)):
            found = stratified(scores[others], bins[others], psi, log_p)
            name = f"psi {depth:g}, {label}"
            yield Check(f"not finite, its own bin unseen: {name}", _not_finite(found.value), 0.0)
        p = _plain(psi).exp()
        means = scores.view(BINS, EACH).mean(-1)
        exact = p * (means - p @ means)
        found = stratified(scores, bins, psi, _plain)
        bound = 4 * BINS * eps(DOUBLE) * float(means.abs().max())
        yield Check(f"closed form: psi {depth:g}", float((found.value - exact).abs().max()), bound)


@case
def allocation(scope: Scope) -> Checks:
    """Images per bin for one-hot, uniform and random p over 1, 8 and 64 bins: they sum to the total, none below the
    minimum, and the importance weights sum to p's mass, k roundings.
    """
    for count in (1, 8, 64):
        random = torch.softmax(3 * torch.randn(count, generator=scope.generator(), dtype=DOUBLE), -1)
        one_hot = torch.eye(count, dtype=DOUBLE)[-1]
        uniform = torch.full((count,), 1.0 / count, dtype=DOUBLE)
        for label, p in (("one-hot", one_hot), ("uniform", uniform), ("random", random)):
            for total in (count, 3 * count + 1, 1000):
                images = allocate(p, total)
                wrong = abs(int(images.sum()) - total) + int((images < 1).sum())
                name = f"{label}, k = {count}, {total} images"
                yield Check(f"images missing: {name}", float(wrong), 0.0)
                weights = importance_weights(p, torch.arange(count).repeat_interleave(images))
                error = abs(math.fsum(weights.tolist()) - 1.0)
                yield Check(f"weights: {name}", error, (total + count) * eps(DOUBLE))


@case
def box_edges(scope: Scope) -> Checks:
    """The boxes' derivative for an object of one pixel, of the whole image, of hard and of ever softer edges.

    Opacity that rises by r per pixel crosses the threshold at a place that moves by -1 / r per unit of
    opacity: 1 / 0.05 at most, by the cap. Edges that the frame clips do not move. The box itself stays on
    whole pixels.
    """
    size = 9
    for rise in (1.0, 0.3, 0.1, 0.04, 1e-6):
        columns = torch.arange(size, dtype=DOUBLE)
        ramp = (0.5 + rise * (columns - 3.5)).clamp(0.0, 1.0).expand(1, size, size)
        opacity = ramp.clone().requires_grad_()
        edges = subpixel_edges(opacity)
        # Left edge: halfway between the centres of columns 3 and 4, that is at 4; the others are the frame's.
        error = float((edges.position.detach()[0] - torch.tensor([4.0, 0.0, size, size])).abs().max())
        yield Check(f"edges: rise {rise:g}", error, 8 * eps(DOUBLE) * size / rise)
        (slope,) = torch.autograd.grad(edges.position[0, 0], opacity, retain_graph=True)
        status = "FLAT" if bool(edges.flat[0, 0]) else "SHARP"
        wanted = ("FLAT",) if rise < SMALLEST_SLOPE else ("SHARP",)
        error = abs(float(slope.sum()) + 1.0 / max(rise, SMALLEST_SLOPE))
        yield Check(f"d edge / d opacity: rise {rise:g}", error, 16 * eps(DOUBLE) / rise**2, status, wanted)
        (slope,) = torch.autograd.grad(edges.position[0, 1:].sum(), opacity)
        yield Check(f"motion of clipped edges: rise {rise:g}", float(slope.abs().max()), 0.0)
    dot = torch.zeros(1, size, size, dtype=DOUBLE)
    dot[0, 4, 6] = 1.0
    for label, image, box in (
        ("one pixel", dot, [6.0, 4.0, 7.0, 5.0]),
        ("the whole image", torch.ones_like(dot), [0.0, 0.0, float(size), float(size)]),
        ("nothing", torch.zeros_like(dot), [0.0] * 4),
    ):
        leaf = image.clone().requires_grad_()
        boxes, _ = boxes_from_opacity(leaf, differentiable=True)
        error = float((boxes.detach()[0, 0] - torch.tensor(box)).abs().max())
        yield Check(f"box: {label}", error, 8 * eps(DOUBLE) * size)
        (slope,) = torch.autograd.grad(boxes.sum(), leaf, allow_unused=True, materialize_grads=True)
        yield Check(f"derivative of the box: {label}", float(slope.abs().max()), 4.0 / SMALLEST_SLOPE)

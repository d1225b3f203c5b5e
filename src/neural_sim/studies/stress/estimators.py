"""Estimators of the mixed derivative at the edges of p and of the scores."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neural_sim.gradient.estimators import reinforce, stratified
from neural_sim.gradient.significance import no_association, no_difference, zero_mean
from neural_sim.parameter import bins as binned
from neural_sim.studies.stress.cases import DOUBLE, Check, Checks, Scope, case, eps, worst

BINS, EACH = 8, 4
KNOWN = torch.arange(BINS).repeat_interleave(EACH)
"""The bin of every score."""


def _floored(psi: Tensor) -> Tensor:
    return binned.log_probabilities(psi, 0.005)


P_OF_PSI = {"no floor": binned.log_probabilities, "floor": _floored}


def _peaked(depth: float) -> Tensor:
    return depth * torch.eye(BINS, dtype=DOUBLE)[2]


@case
def constant_scores(scope: Scope) -> Checks:
    """Estimate from equal scores: no bin is better, and the derivative is exactly 0.

    Not even rounding errors are allowed, since an update that normalises the gradient would make them a full step.
    """
    for value in (1.0, 0.1, -1e8, 1e-300, 1e100):
        scores = torch.full((len(KNOWN),), value, dtype=DOUBLE)
        for label, log_p in P_OF_PSI.items():
            for depth in (0.0, 1.7, 1000.0):
                estimate = stratified(scores.view(BINS, EACH), _peaked(depth), log_p)
                yield Check(
                    f"stratified: score {value:g}, psi {depth:g}, {label}", worst(estimate.value), 0.0
                )
        estimate = reinforce(scores, lambda psi: binned.log_probabilities(psi)[KNOWN], _peaked(1.7))
        # Its baseline is the mean of all scores, known to n eps, and has a slope of at most 1.
        yield Check(
            f"reinforce: score {value:g}", worst(estimate.value), len(KNOWN) * eps(DOUBLE) * abs(value)
        )


@case
def score_scales(scope: Scope) -> Checks:
    """Estimate from scores scaled by powers of two: the derivative scales exactly, without changing a digit.

    An offset common to all scores changes the derivative only by rounding, n eps times the offset.
    """
    table, psi = scope.normal(BINS, EACH), scope.normal(BINS)
    plain = stratified(table, psi, _floored)
    for power in (-400, -100, 100, 400):
        estimate = stratified(table * 2.0**power, psi, _floored)
        yield Check(
            f"derivative in units of 2^{power}", worst(estimate.value * 2.0**-power - plain.value), 0.0
        )
        change = worst(estimate.standard_error * 2.0**-power - plain.standard_error)
        yield Check(f"standard error in units of 2^{power}", change, 0.0)
    for offset in (1e4, 1e12):
        estimate = stratified(table + offset, psi, _floored)
        bound = 2 * len(KNOWN) * eps(DOUBLE) * offset * worst(_floored(psi).exp())
        yield Check(f"offset of {offset:g}", worst(estimate.value - plain.value), bound)


@case
def significance(scope: Scope) -> Checks:
    """Compute p-values of data scaled by powers of two: no digit changes.

    The p-value is 1 if the data say nothing: equal scores, one image, a single nonzero row, or numbers that are not
    finite. It is also 1 with one image per bin, since every permutation has the same statistic.
    """
    bins = torch.eye(BINS, dtype=DOUBLE).repeat_interleave(EACH, 0)
    scores, rows = scope.normal(len(bins)), scope.normal(len(bins), BINS)
    tilted, told = scores + bins[:, 0], rows + 0.3
    for power in (-1000, -400, 400, 1000):
        change = abs(no_association(tilted * 2.0**power, bins) - no_association(tilted, bins))
        yield Check(f"association in units of 2^{power}", change, 0.0)
        yield Check(f"mean in units of 2^{power}", abs(zero_mean(told * 2.0**power) - zero_mean(told)), 0.0)
    nothing = {
        "equal scores": no_association(torch.full_like(scores, 0.1), bins),
        "one bin drawn": no_association(scores, torch.ones_like(bins)),
        "one image": no_association(scores[:1], bins[:1]),
        "one image per bin": no_association(scores[:BINS], bins[::EACH]),
        "a score of NaN": no_association(scores.clone().index_fill_(0, torch.tensor(0), math.nan), bins),
        "one scene": no_difference(scores[None]),
        "a scene's scores equal under every light": no_difference(scores[:, None].expand(-1, 3)),
        "no rows but zeros": zero_mean(torch.zeros_like(rows)),
        "one row among zeros": zero_mean(torch.eye(BINS, dtype=DOUBLE)[:, :1] * rows[:1]),
        "a row of inf": zero_mean(rows.clone().index_fill_(0, torch.tensor(0), math.inf)),
    }
    for name, p_value in nothing.items():
        yield Check(f"p-value below 1: {name}", 1.0 - p_value, 0.0)


@case
def one_hot(scope: Scope) -> Checks:
    """Estimate at p from uniform to one-hot, and compare with the closed form p_i (s_i - sum_j p_j s_j)."""
    table = scope.normal(BINS, EACH)
    means = table.mean(-1)
    for depth in (0.0, 20.0, 1000.0):
        psi = _peaked(depth)
        p = binned.log_probabilities(psi).exp()
        estimate = stratified(table, psi, binned.log_probabilities)
        error = worst(estimate.value - p * (means - p @ means))
        yield Check(f"closed form: psi {depth:g}", error, 4 * BINS * eps(DOUBLE) * worst(means))

"""Weights on the simplex (what illumination learns), against an exact solution in rational arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor

from neural_sim.parameter.simplex import project_simplex, project_sum
from neural_sim.stress.cases import Check, Checks, Scope, case, eps


def exact_projection(values: Tensor) -> list[float]:
    """The projection of one vector without any rounding, from the optimality conditions of the quadratic
    programme.

    ``w = max(v - t, 0)`` with the t that makes the sum 1; the sum falls in t, so among the thresholds that
    the m largest entries give the largest one is t.
    """
    entries = [Fraction(float(value)) for value in values]
    ordered = sorted(entries, reverse=True)
    threshold = max((sum(ordered[:m], Fraction(0)) - 1) / m for m in range(1, len(ordered) + 1))
    return [float(max(entry - threshold, Fraction(0))) for entry in entries]


def _extremes(dtype: torch.dtype, generator: torch.Generator) -> dict[str, Tensor]:
    def of(*values: float) -> Tensor:
        return torch.tensor(values, dtype=dtype)

    noise = torch.randn(64, generator=generator, dtype=torch.float64)
    return {
        "a corner": of(1.0, 0.0, 0.0),
        "outside a corner": of(3.0, -2.0, 0.1),
        "just off a corner": of(1.0 - 1e-6, 1e-6, -1e-6),
        "an edge": of(0.5, 0.5, -0.3),
        "all equal": of(*[0.7] * 7),
        "ties at the threshold": of(1.0, 0.0, 0.0, 0.0, -1.0),
        "one weight": of(-5.0),
        "two huge ties": of(1e30, 1e30, -1e30),
        "one huge": of(1e30, 1.0, 0.5),
        "huge and negative": of(-1e30, -1e30, -1e30, -1e30),
        "the largest numbers": of(torch.finfo(dtype).max, -torch.finfo(dtype).max, 0.0),
        "tiny": of(1e-30, -1e-30, 2e-30),
        "near ties at 1e6": of(1e6 + 0.25, 1e6, 1e6 - 0.5),
        "64 weights": noise.to(dtype),
        "64 stiff weights": (noise * 10.0 ** (noise * 4)).to(dtype),
    }


@case
def projection(scope: Scope) -> Checks:
    """The projection of the very float given, in exact rational arithmetic, against the code.

    Differences to the largest entry are at most 1 after clamping and rounded once (eps / 2 of at most 1), the
    sum of k of them by k eps, the threshold and the result once more: (k + 4) eps. The weights then sum to 1
    within k times that.
    """
    for dtype in (torch.float64, torch.float32):
        for label, values in _extremes(dtype, scope.generator()).items():
            weights = project_simplex(values)
            count = len(values)
            truth = torch.tensor(exact_projection(values), dtype=torch.float64)
            name = f"{label}, {str(dtype).removeprefix('torch.')}"
            bound = (count + 4) * eps(dtype)
            yield Check(f"error: {name}", float((weights.double() - truth).abs().max()), bound)
            outside = float(-weights.min().clamp_max(0.0))
            wrong = abs(math.fsum(weights.tolist()) - 1.0) + outside
            yield Check(f"distance to the simplex: {name}", wrong, count * bound)


@case
def corners(scope: Scope) -> Checks:
    """A corner is its own projection, bit for bit, and stays so under a step of any size that leaves the
    simplex there; the derivative at the inside of a face of m weights is I - 1 1^T / m on them and 0
    elsewhere.
    """
    for count in (2, 4, 64):
        for step in (1e-12, 1.0, 1e12):
            corner = torch.eye(count, dtype=torch.float64)
            outward = corner - (1.0 - corner)
            value = float((project_simplex(corner + step * outward) - corner).abs().max())
            # corner + step rounds by eps times the entry, of which only differences of at most 1 are seen
            yield Check(
                f"change of a corner: {count} weights, step {step:g}", value, 2.0 * eps(torch.float64)
            )
        value = float((project_simplex(torch.eye(count, dtype=torch.float64)) - torch.eye(count)).abs().max())
        yield Check(f"change of a corner: {count} weights", value, 0.0)
    point = torch.tensor([0.6, 0.4, 0.0, -3.0], dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(project_simplex, point - torch.tensor([0.0, 0.0, 0.5, 0.0]))
    truth = torch.zeros(4, 4, dtype=torch.float64)
    truth[:2, :2] = torch.tensor([[0.5, -0.5], [-0.5, 0.5]])
    yield Check("derivative on an edge", float((jacobian - truth).abs().max()), 8 * eps(torch.float64))


@case
def sum_constraint(scope: Scope) -> Checks:
    """v - (mean(v) - 1 / k): mean and differences round by k eps max|v| each, and k of them are summed."""
    for dtype in (torch.float64, torch.float32):
        for label, values in _extremes(dtype, scope.generator()).items():
            weights = project_sum(values)
            count, largest = len(values), max(1.0, float(values.abs().max()))
            wrong = abs(math.fsum(weights.double().tolist()) - 1.0)
            bound = 3 * count * eps(dtype) * largest * count
            yield Check(f"sum - 1: {label}, {str(dtype).removeprefix('torch.')}", wrong, bound)


@case
def refusals(scope: Scope) -> Checks:
    """Entries that are not finite and no entries at all are refused, never projected to NaN."""
    for label, values in (
        ("NaN", torch.tensor([0.5, math.nan])),
        ("inf", torch.tensor([math.inf, 0.0])),
        ("empty", torch.zeros(0)),
    ):
        for function in (project_simplex, project_sum):
            try:
                function(values)
                status = "accepted"
            except ValueError:
                status = "ValueError"
            yield Check(
                f"{function.__name__}, {label}", float(status == "accepted"), 0.0, status, ("ValueError",)
            )

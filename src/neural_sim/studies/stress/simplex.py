"""Projection onto the simplex, for weights of lights, against an exact solution in rational arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor

from neural_sim.parameter.distributions import project_simplex, project_sum
from neural_sim.studies.stress.cases import DOUBLE, SINGLE, Check, Checks, Scope, case, eps, short, worst


def exact_projection(values: Tensor) -> list[float]:
    """Project one vector without any rounding, from the optimality conditions of the quadratic programme.

    ``w = max(v - t, 0)`` with the t that makes the sum 1; the sum falls in t, so t is the largest of the thresholds
    given by the m largest entries, over all m.
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
    """Project vectors, against the exact projection of the same floats, in rational arithmetic.

    After clamping, differences from the largest entry are at most 1 and are rounded once (eps / 2). Their sum over k
    entries adds k eps, the threshold and the result one rounding each: (k + 4) eps in all. The weights then sum to
    1 within k times that. On the plane of sum 1, v - (mean(v) - 1 / k): mean and differences round by k eps max|v|
    each, and k of them are summed.
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

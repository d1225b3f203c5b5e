"""A full-batch minimiser that ends at a stationary point: Newton steps by conjugate gradients with a line search.

Deterministic, for finite differences through retrained problems; detectors are trained by :mod:`detector.training`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.hvp import HessianOperator, Term
from neural_sim.solver.operator import Matvec, Shifted, dot, flatten, norm, unflatten


@dataclass(frozen=True)
class Minimum:
    """Where a minimisation ended. ``slope`` is the gradient's norm there; ``products`` counts Hessian products."""

    params: dict[str, Tensor]
    value: float
    slope: float
    converged: bool
    steps: int
    products: int


def minimise(
    terms: Sequence[Term],
    params: Mapping[str, Tensor],
    tolerance: float,
    max_steps: int = 50,
    max_products: int = 200,
) -> Minimum:
    """Minimise ``sum(term(params) for term in terms)`` until the gradient's norm is at most ``tolerance``.

    Newton's method with Levenberg and Marquardt's shift: a step's system is solved by conjugate gradients in at most
    ``max_products`` products, shifted past whatever negative curvature they meet, then searched along. Not converged
    after ``max_steps`` or where no step helps. Raises ``ValueError`` for a tolerance that is not positive.
    """
    if not tolerance > 0.0:
        raise ValueError(f"minimise: tolerance must be positive, got {tolerance}")
    point = flatten(params).detach()
    value, slope = _value_and_gradient(terms, params, point)
    size, first, products, step, shift = norm(slope), norm(slope), 0, 0, 0.0
    while size > tolerance and step < max_steps:
        operator = HessianOperator(terms, unflatten(point, params), retain_graph=True)
        # Eisenstat and Walker's forcing: loose far away, tight close by, and no tighter than the end asks for.
        forcing = max(min(0.1, (size / first) ** 0.5), 0.1 * tolerance / size)
        direction, shift, spent = _direction(operator, slope, min(forcing, 0.5), max_products, 0.25 * shift)
        products += spent
        accepted = _search(terms, params, point, direction, value, slope)
        step += 1
        if accepted is None:
            break
        point, value, slope = accepted
        size = norm(slope)
    return Minimum(dict(unflatten(point, params)), value, size, size <= tolerance, step, products)


def _direction(
    operator: Matvec, slope: Float[Tensor, "n"], rtol: float, max_products: int, shift: float
) -> tuple[Float[Tensor, "n"], float, int]:
    """The step ``-(H + shift I)^-1 slope``, the shift raised until no negative curvature is met; and products spent."""
    spent = 0
    while True:
        shifted = Shifted(operator, shift)
        solution = ConjugateGradient().solve(shifted, -slope, rtol=rtol, max_steps=max_products)
        spent += solution.products
        if solution.status is not Status.NEGATIVE_CURVATURE:
            return solution.value, shift, spent
        lowest = solution.curvature[0] - shift
        shift = max(2.0 * shift, -1.5 * lowest, 1e-8 * max(solution.curvature[1], 1e-8))


def _search(
    terms: Sequence[Term],
    like: Mapping[str, Tensor],
    point: Float[Tensor, "n"],
    direction: Float[Tensor, "n"],
    value: float,
    slope: Float[Tensor, "n"],
    halvings: int = 40,
) -> tuple[Float[Tensor, "n"], float, Float[Tensor, "n"]] | None:
    """The first halved step that lowers the value enough (Armijo); None if none does.

    Where the change of the value drowns in rounding, a step that lowers the gradient's norm will do.
    """
    descent, rounding = dot(direction, slope), 100.0 * torch.finfo(point.dtype).eps * abs(value)
    length = 1.0
    for _ in range(halvings):
        moved = point + length * direction
        reached, there = _value_and_gradient(terms, like, moved)
        lower = reached <= value + 1e-4 * length * descent
        if lower or (abs(reached - value) <= rounding and norm(there) < norm(slope)):
            return moved, reached, there
        length *= 0.5
    return None


def _value_and_gradient(
    terms: Sequence[Term], like: Mapping[str, Tensor], point: Float[Tensor, "n"]
) -> tuple[float, Float[Tensor, "n"]]:
    total, slope = 0.0, torch.zeros_like(point)
    for term in terms:
        leaf = point.detach().requires_grad_()
        with torch.enable_grad():
            loss = term(unflatten(leaf, like))
        slope += torch.autograd.grad(loss, leaf, materialize_grads=True)[0]
        total += float(loss.detach())
    return total, slope

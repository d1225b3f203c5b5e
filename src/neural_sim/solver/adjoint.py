"""``v = (H + lambda I)^-1 b`` from a curvature operator, a damping and a linear solver."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from annotated_types import Ge, Lt
from jaxtyping import Float
from torch import Tensor

from neural_sim.ranges import NonNegativeInt, PositiveInt, validated
from neural_sim.solver.base import LinearSolver, Solution, Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import Damped, Damping, LanczosDamping
from neural_sim.solver.direct import Identity
from neural_sim.solver.hvp import HessianOperator, Mode, Term
from neural_sim.solver.operator import Matvec, Shifted

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Adjoint:
    """The solution and its damping.

    ``damping_raises`` counts the increases of lambda. The solution's ``products`` include those of every solve that
    was needed.
    """

    solution: Solution
    damping: Damped
    damping_raises: int

    @property
    def vector(self) -> Float[Tensor, "n"]:
        """``(H + lambda I)^-1 b``."""
        return self.solution.value


@validated
@dataclass(frozen=True)
class AdjointSolver:
    """Solves ``(H + lambda I) v = b`` for H the Hessian of a sum of loss terms.

    Args:
        linear: the linear solver.
        damping: the choice of lambda; ``Identity`` takes none, so that its lambda is 0.
        mode: how Hessian products are computed, see ``HessianOperator``.
        rtol, max_steps: passed to the linear solver.
        retain_graph: see ``HessianOperator``.
        max_raises: limit on the increases of lambda after negative curvature was met (a fixed lambda is never raised).
    """

    linear: LinearSolver = field(default_factory=ConjugateGradient)
    damping: Damping = field(default_factory=LanczosDamping)
    mode: Mode = "reverse_over_reverse"
    rtol: Annotated[float, Ge(0), Lt(1)] = 3e-2
    max_steps: PositiveInt = 40
    retain_graph: bool = True
    max_raises: NonNegativeInt = 3

    def solve(
        self,
        terms: Sequence[Term],
        params: Mapping[str, Tensor],
        b: Float[Tensor, "n"],
        x0: Float[Tensor, "n"] | None,
        generator: torch.Generator,
    ) -> Adjoint:
        """Solve for the right-hand side ``b``, warm-started from ``x0``.

        ``generator`` draws the start vector of the damping's estimate, if that does not start from ``b``.
        """
        operator = self.operator(terms, params)
        # A multiple of b does not depend on lambda, which would take products to choose.
        plain = isinstance(self.linear, Identity)
        damped = Damped(0.0, None) if plain else self.damping.choose(operator, b, generator)
        solution = self._solve(operator, damped, b, x0)
        damping_raises = 0
        while solution.status is Status.NEGATIVE_CURVATURE and damping_raises < self.max_raises:
            raised = self.damping.raised(damped, solution.curvature[0] - damped.value)
            if raised is None:
                break
            logger.info("damping: negative curvature met; lambda %.3g -> %.3g", damped.value, raised.value)
            damped, damping_raises = raised, damping_raises + 1
            solution = _after(solution, self._solve(operator, damped, b, solution.value))
        return Adjoint(solution, damped, damping_raises)

    def _solve(self, operator: Matvec, damped: Damped, b: Tensor, x0: Tensor | None) -> Solution:
        """Solve, from the damping's Krylov search or, without one, from ``x0``."""
        searched = damped.search()
        start = x0 if searched is None else searched
        return self.linear.solve(Shifted(operator, damped.value), b, start, self.rtol, self.max_steps)

    def operator(self, terms: Sequence[Term], params: Mapping[str, Tensor]) -> Matvec:
        """Make the operator of products with the undamped Hessian."""
        return HessianOperator(terms, params, self.mode, self.retain_graph)


def _after(other: Solution, solution: Solution) -> Solution:
    """Add the products of another solve to those of the solution."""
    return replace(solution, products=other.products + solution.products)

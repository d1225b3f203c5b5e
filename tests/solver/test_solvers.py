"""What each linear solver does beside solving: reports, warm starts, references of other libraries. Condition numbers,
indefinite, singular and extreme systems are the stress suite's (``neural_sim/studies/stress/linear.py``)."""

from __future__ import annotations

import math

import numpy
import pytest
import scipy.sparse.linalg
import torch

from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.direct import Exact, Identity
from neural_sim.solver.minres import MinimumResidual

DOUBLE = torch.float64
SIZE = 24


def test_identity_reports_an_honest_residual(symmetric, right_hand_side, spread):
    matrix, b = symmetric(spread(1e2)), right_hand_side()
    solution = Identity(scale=2.0).solve(lambda v: matrix @ v, b)
    torch.testing.assert_close(solution.value, 2.0 * b)
    assert solution.status is Status.APPROXIMATE
    assert solution.residual == pytest.approx(float((b - 2.0 * matrix @ b).norm() / b.norm()))
    with pytest.raises(ValueError, match=r"^Identity\.scale: want a number other than 0"):
        Identity(scale=0.0)


def test_conjugate_gradients_name_the_negative_curvature_seen():
    matrix = torch.diag(torch.tensor([2.0, -1.0], dtype=DOUBLE))
    solution = ConjugateGradient().solve(lambda v: matrix @ v, torch.tensor([0.5, 2.0], dtype=DOUBLE))
    assert solution.status is Status.NEGATIVE_CURVATURE
    assert solution.curvature[0] < 0.0
    assert solution.value.norm() == 0.0 and solution.residual == 1.0


@pytest.mark.parametrize(
    ("energy", "status"), [(1e-17, Status.NEGATIVE_CURVATURE), (1e-14, Status.MAX_STEPS)]
)
def test_conjugate_gradients_take_no_step_along_curvature_below_rounding(energy, status):
    """Along b, the product is orthogonal to b but for ``energy``, less or more than the machine epsilon 2e-16."""
    matrix = torch.tensor([[energy, 1.0], [1.0, 0.0]], dtype=DOUBLE)
    b = torch.tensor([1.0, 0.0], dtype=DOUBLE)
    assert ConjugateGradient().solve(matrix.mv, b, max_steps=1).status is status


def test_minres_matches_scipy_step_by_step(symmetric, right_hand_side, spread):
    eigenvalues = torch.cat([spread(1e3, 12), -spread(1e2, 12)])
    matrix, b = symmetric(eigenvalues), right_hand_side()
    for steps in (1, 2, 5, 11):
        ours = MinimumResidual().solve(lambda v: matrix @ v, b, rtol=0.0, max_steps=steps)
        theirs, _ = scipy.sparse.linalg.minres(matrix.numpy(), b.numpy(), rtol=1e-30, maxiter=steps)
        numpy.testing.assert_allclose(ours.value.numpy(), theirs, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("seed", range(8))
def test_minres_claims_a_least_squares_solution_only_where_it_is_one(
    seed, symmetric, right_hand_side, spread
):
    """At condition 1e12 rounding, not the range, is what the residual stops at: its recurrence cannot tell."""
    matrix = symmetric(spread(1e12), seed)
    b = matrix @ right_hand_side(seed=seed)
    solution = MinimumResidual().solve(lambda v: matrix @ v, b, rtol=1e-13, max_steps=2000)
    residual = b - matrix @ solution.value
    slope = float((matrix @ residual).norm() / residual.norm())
    least_squares = slope <= 10 * torch.finfo(DOUBLE).eps ** 0.5
    assert least_squares or solution.status is not Status.LEAST_SQUARES


def test_warm_start_is_used_or_dropped(symmetric, right_hand_side, spread):
    matrix, b = symmetric(spread(1e2)), right_hand_side()
    close = torch.linalg.solve(matrix, b) * (1 + 1e-3)
    for solver in (ConjugateGradient(), MinimumResidual()):
        warm = solver.solve(lambda v: matrix @ v, b, x0=close, rtol=1e-4, max_steps=900)
        cold = solver.solve(lambda v: matrix @ v, b, rtol=1e-4, max_steps=900)
        assert warm.warm_started and not cold.warm_started
        assert warm.status is Status.CONVERGED and warm.steps < cold.steps
        for useless in (-close, torch.full_like(b, math.nan), torch.zeros_like(b)):
            dropped = solver.solve(lambda v: matrix @ v, b, x0=useless, rtol=1e-4, max_steps=900)
            assert not dropped.warm_started
            torch.testing.assert_close(dropped.value, cold.value)


@pytest.mark.parametrize(("solver", "products"), [(Identity(), 1), (Exact(), SIZE + 1)])
def test_direct_solvers_take_no_start_and_spend_no_product_on_it(
    solver, products, symmetric, right_hand_side, spread
):
    matrix, b = symmetric(spread(1e2)), right_hand_side()
    close = torch.linalg.solve(matrix, b) * (1 + 1e-3)
    found = solver.solve(lambda v: matrix @ v, b, x0=close)
    assert not found.warm_started and found.products == products


def test_minres_spends_one_product_a_step_and_one_on_the_residual(symmetric, right_hand_side, spread):
    matrix, b = symmetric(spread(1e2)), right_hand_side()
    found = MinimumResidual().solve(lambda v: matrix @ v, b, rtol=1e-6, max_steps=900)
    assert found.status is Status.CONVERGED and found.products == found.steps + 1
    assert found.residual == pytest.approx(float((b - matrix @ found.value).norm() / b.norm()), rel=1e-6)
    spent = MinimumResidual().solve(lambda v: matrix @ v, b, rtol=1e-6, max_steps=5)
    assert spent.status is Status.MAX_STEPS and spent.products == spent.steps + 1 == 6
    assert spent.residual == pytest.approx(float((b - matrix @ spent.value).norm() / b.norm()), rel=1e-6)


def test_best_iterate_is_kept(symmetric, right_hand_side, spread):
    matrix, b = symmetric(spread(1e6)), right_hand_side()
    residuals = [
        ConjugateGradient().solve(lambda v: matrix @ v, b, rtol=0.0, max_steps=steps).residual
        for steps in range(1, 15)
    ]
    assert residuals == sorted(residuals, reverse=True)
    assert len(set(residuals)) < len(residuals)  # plain conjugate gradients would have risen somewhere


def test_convergence_is_claimed_from_the_true_residual(symmetric, right_hand_side, spread):
    matrix, b = symmetric(spread(1e8)).float(), right_hand_side().float()
    solution = ConjugateGradient().solve(lambda v: matrix @ v, b, rtol=1e-5, max_steps=2000)
    true = float((b.double() - matrix.double() @ solution.value.double()).norm() / b.norm())
    assert (solution.status is Status.CONVERGED) == (solution.residual <= 1e-5)
    assert true == pytest.approx(solution.residual, rel=0.05, abs=1e-6)

"""The Krylov space that the damping's estimate searched solves the damped system without further products."""

import dataclasses
import math

import pytest
import torch

from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Search, Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping, lanczos
from neural_sim.solver.direct import Exact
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.operator import Shifted

DOUBLE = torch.float64


@pytest.fixture
def system(generator):
    eigenvalues = torch.cat(
        [torch.tensor([-0.3, -0.1], dtype=DOUBLE), torch.logspace(-2, 1, 28, dtype=DOUBLE)]
    )
    q, _ = torch.linalg.qr(torch.randn(30, 30, generator=generator, dtype=DOUBLE))
    return q @ torch.diag(eigenvalues) @ q.T, torch.randn(30, generator=generator, dtype=DOUBLE)


@pytest.mark.parametrize("steps", [1, 5, 12])
def test_it_is_what_as_many_steps_of_conjugate_gradients_reach(system, steps):
    matrix, b = system
    found = lanczos(matrix.matmul, b, steps).krylov.search(0.5)
    shifted = matrix + 0.5 * torch.eye(30, dtype=DOUBLE)
    x, r = torch.zeros_like(b), b.clone()
    p = r.clone()
    for _ in range(steps):
        alpha = (r @ r) / (p @ shifted @ p)
        x, new = x + alpha * p, r - alpha * (shifted @ p)
        p, r = new + (new @ new) / (r @ r) * p, new
    torch.testing.assert_close(found.value, x, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(found.residual, r, rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(found.direction, p, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("more", [1, 4, 9])
def test_conjugate_gradients_go_on_as_if_they_had_made_the_estimates_steps(system, more):
    matrix, b = system
    shifted = Shifted(matrix.matmul, 0.5)
    search = lanczos(matrix.matmul, b, 6).krylov.search(0.5)
    gone_on = ConjugateGradient().solve(shifted, b, search, rtol=0.0, max_steps=more)
    whole = ConjugateGradient().solve(shifted, b, rtol=0.0, max_steps=6 + more)
    torch.testing.assert_close(gone_on.value, whole.value, rtol=1e-7, atol=1e-9)
    assert gone_on.warm_started
    assert gone_on.products == more + 1  # the check of the residual; none to find out where the search stands
    # From the value alone they have to begin anew, and get less far in as many steps.
    restarted = ConjugateGradient().solve(shifted, b, search.value, rtol=0.0, max_steps=more)
    assert gone_on.residual <= restarted.residual


@pytest.mark.parametrize("solver", [ConjugateGradient(), MinimumResidual(), Exact()])
def test_every_solver_takes_a_search(system, solver):
    matrix, b = system
    search = lanczos(matrix.matmul, b, 6).krylov.search(0.5)
    expected = torch.linalg.solve(matrix + 0.5 * torch.eye(30, dtype=DOUBLE), b)
    found = solver.solve(Shifted(matrix.matmul, 0.5), b, search, rtol=1e-8, max_steps=2000)
    assert found.status is Status.CONVERGED
    torch.testing.assert_close(found.value, expected, rtol=1e-5, atol=1e-6)


def test_a_search_that_says_it_is_done_is_not_believed(system):
    """Its residual is a recurrence's: the solver makes a product of its own and goes on from what that shows."""
    matrix, b = system
    shifted = Shifted(matrix.matmul, 0.5)
    search = lanczos(matrix.matmul, b, 6).krylov.search(0.5)
    liar = dataclasses.replace(search, residual=1e-9 * search.residual)
    found = ConjugateGradient().solve(shifted, b, liar, rtol=1e-6, max_steps=60)
    expected = torch.linalg.solve(matrix + 0.5 * torch.eye(30, dtype=DOUBLE), b)
    assert found.status is Status.CONVERGED and found.steps > 0
    torch.testing.assert_close(found.value, expected, rtol=1e-3, atol=1e-4)
    true = dataclasses.replace(search, value=expected, residual=0.0 * b)
    at_once = ConjugateGradient().solve(shifted, b, true, rtol=1e-6)
    assert (at_once.status, at_once.steps, at_once.products) == (Status.CONVERGED, 0, 1)


@pytest.mark.parametrize("bad", [math.nan, 2.0])
def test_a_search_worse_than_zero_is_dropped(system, bad):
    matrix, b = system
    wrong = Search(torch.full_like(b, bad), bad * b, b)
    found = ConjugateGradient().solve(Shifted(matrix.matmul, 0.5), b, wrong, rtol=1e-8, max_steps=60)
    cold = ConjugateGradient().solve(Shifted(matrix.matmul, 0.5), b, rtol=1e-8, max_steps=60)
    assert not found.warm_started
    torch.testing.assert_close(found.value, cold.value)


def test_the_full_space_solves_exactly_at_any_shift(system):
    matrix, b = system
    krylov = lanczos(matrix.matmul, b, 30).krylov
    for shift in (0.4, 1.0, 100.0):
        expected = torch.linalg.solve(matrix + shift * torch.eye(30, dtype=DOUBLE), b)
        torch.testing.assert_close(krylov.search(shift).value, expected, rtol=1e-8, atol=1e-10)
    assert krylov.search(0.2) is None  # not positive definite: -0.3 + 0.2 < 0


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_the_right_hand_sides_size_does_not_matter(system, size):
    matrix, b = system
    one = lanczos(matrix.matmul, b, 8).krylov.search(0.5)
    other = lanczos(matrix.matmul, size * b, 8).krylov.search(0.5).divided(size)
    torch.testing.assert_close(dataclasses.astuple(other), dataclasses.astuple(one))


def test_the_adjoint_solve_makes_no_product_twice(generator):
    """A quadratic loss: once the estimate's space holds the solution, the solver only checks it."""
    draw = torch.randn(12, 12, generator=generator, dtype=DOUBLE)
    matrix, b = draw @ draw.T / 12, torch.randn(12, generator=generator, dtype=DOUBLE)

    def loss(params):
        return 0.5 * params["x"] @ matrix @ params["x"]

    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=12), rtol=1e-6)
    found = solver.solve([loss], {"x": torch.zeros(12, dtype=DOUBLE)}, b, None, generator)
    assert found.solution.status.name == "CONVERGED"
    assert (found.solution.steps, found.solution.products) == (0, 1)
    expected = torch.linalg.solve(matrix + found.damping.value * torch.eye(12, dtype=DOUBLE), b)
    torch.testing.assert_close(found.vector, expected, rtol=1e-5, atol=1e-8)

"""The Krylov space that the damping's estimate searched solves the damped system without further products."""

import pytest
import torch

from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import LanczosDamping
from neural_sim.solver.lanczos import lanczos

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
    found = lanczos(matrix.matmul, b, steps).krylov.solve(0.5)
    shifted = matrix + 0.5 * torch.eye(30, dtype=DOUBLE)
    x, r = torch.zeros_like(b), b.clone()
    p = r.clone()
    for _ in range(steps):
        alpha = (r @ r) / (p @ shifted @ p)
        x, new = x + alpha * p, r - alpha * (shifted @ p)
        p, r = new + (new @ new) / (r @ r) * p, new
    torch.testing.assert_close(found, x, rtol=1e-8, atol=1e-10)


def test_the_full_space_solves_exactly_at_any_shift(system):
    matrix, b = system
    krylov = lanczos(matrix.matmul, b, 30).krylov
    for shift in (0.4, 1.0, 100.0):
        expected = torch.linalg.solve(matrix + shift * torch.eye(30, dtype=DOUBLE), b)
        torch.testing.assert_close(krylov.solve(shift), expected, rtol=1e-8, atol=1e-10)
    assert krylov.solve(0.2) is None  # not positive definite: -0.3 + 0.2 < 0


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_the_right_hand_sides_size_does_not_matter(system, size):
    matrix, b = system
    one = lanczos(matrix.matmul, b, 8).krylov.solve(0.5)
    torch.testing.assert_close(lanczos(matrix.matmul, size * b, 8).krylov.solve(0.5) / size, one)


def test_the_adjoint_solve_makes_no_product_twice(generator):
    """A quadratic loss: once the estimate's space holds the solution, the solver only checks it."""
    draw = torch.randn(12, 12, generator=generator, dtype=DOUBLE)
    matrix, b = draw @ draw.T / 12, torch.randn(12, generator=generator, dtype=DOUBLE)

    def loss(params):
        return 0.5 * params["x"] @ matrix @ params["x"]

    solver = AdjointSolver(ConjugateGradient(), LanczosDamping(lanczos_steps=12), rtol=1e-6)
    found = solver.solve([loss], {"x": torch.zeros(12, dtype=DOUBLE)}, b, None, generator)
    assert found.solution.status.name == "CONVERGED"
    assert found.solution.steps == 0
    expected = torch.linalg.solve(matrix + found.damping.value * torch.eye(12, dtype=DOUBLE), b)
    torch.testing.assert_close(found.vector, expected, rtol=1e-5, atol=1e-8)

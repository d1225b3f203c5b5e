"""The sign of Eq. 2, and of what the authors' code forms, on a bilevel problem whose inner solution is a closed form.

Written from the formulas: L_train = 1/2 mean (x_j(psi) . theta - y_j)^2 + ridge, L_val = 1/2 |B theta - c|^2.
docs/paper.md, The authors' code, says where the code has which line.
"""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

DOUBLE = torch.float64
SEEDS = range(40)


@dataclass(frozen=True)
class Problem:
    """``still`` and ``moving`` make the images x_j = still_j + moving_j tanh(psi)."""

    still: Tensor
    moving: Tensor
    y: Tensor
    b: Tensor
    c: Tensor
    psi: Tensor

    @staticmethod
    def of(seed: int) -> "Problem":
        drawn = torch.Generator().manual_seed(seed)
        shapes = ((24, 4), (24, 4, 3), (24,), (6, 4), (6,), (3,))
        return Problem(*(torch.randn(shape, generator=drawn, dtype=DOUBLE) for shape in shapes))

    def images(self, psi):
        return self.still + self.moving @ torch.tanh(psi)

    def training_loss(self, theta, psi):
        return 0.5 * (self.images(psi) @ theta - self.y).square().mean() + 0.05 * theta.square().sum()

    def solution(self, psi):
        x = self.images(psi)
        gram = x.T @ x / len(x) + 0.1 * torch.eye(x.shape[1], dtype=DOUBLE)
        return torch.linalg.solve(gram, x.T @ self.y / len(x))

    def validation_loss(self, theta):
        return 0.5 * (self.b @ theta - self.c).square().sum()

    def outer_loss(self, psi):
        return float(self.validation_loss(self.solution(psi)))

    def contracted(self, vector):
        """``d/dpsi <dL_train/dtheta, v>`` with v held fixed."""
        theta, psi = self.solution(self.psi).requires_grad_(), self.psi.clone().requires_grad_()
        (slope,) = torch.autograd.grad(self.training_loss(theta, psi), theta, create_graph=True)
        return torch.autograd.grad(slope @ vector, psi)[0]

    @property
    def hessian(self):
        theta = self.solution(self.psi)
        return torch.autograd.functional.hessian(lambda t: self.training_loss(t, self.psi), theta)

    @property
    def slope(self):
        """``dL_val/dtheta``."""
        theta = self.solution(self.psi).requires_grad_()
        return torch.autograd.grad(self.validation_loss(theta), theta)[0]

    @property
    def equation_2(self):
        return -self.contracted(torch.linalg.solve(self.hessian, self.slope))

    @property
    def authors(self):
        """One product with the Hessian and a damping of 0.01 in the place of the inverse; no minus."""
        return self.contracted(self.hessian @ self.slope + 0.01 * self.slope)

    def after(self, gradient):
        """The change of the outer loss by a small step of a descent: ``psi - rate * gradient``."""
        step = 1e-4 * gradient / gradient.norm()
        return self.outer_loss(self.psi - step) - self.outer_loss(self.psi)


@pytest.mark.parametrize("seed", SEEDS)
def test_equation_2_is_the_derivative_and_a_descent_along_it_lowers_the_outer_loss(seed):
    problem = Problem.of(seed)
    step = 1e-5 * torch.eye(3, dtype=DOUBLE)
    central = torch.tensor(
        [
            (problem.outer_loss(problem.psi + each) - problem.outer_loss(problem.psi - each)) / 2e-5
            for each in step
        ],
        dtype=DOUBLE,
    )
    torch.testing.assert_close(problem.equation_2, central, rtol=1e-6, atol=1e-8)
    assert problem.after(problem.equation_2) < 0.0


@pytest.mark.parametrize("seed", SEEDS)
def test_the_same_descent_along_equation_2_without_its_minus_raises_it(seed):
    problem = Problem.of(seed)
    without = problem.contracted(torch.linalg.solve(problem.hessian, problem.slope))
    torch.testing.assert_close(without, -problem.equation_2)
    assert problem.after(without) > 0.0


def test_the_authors_form_raises_it_nearly_always():
    """A product in the place of the inverse weighs the Hessian's directions the other way round, so that its direction
    is not the exact one's; but it is a positive definite matrix, too.
    """
    problems = [Problem.of(seed) for seed in SEEDS]
    raised = sum(problem.after(problem.authors) > 0.0 for problem in problems)
    lowered = sum(problem.after(-problem.authors) < 0.0 for problem in problems)
    assert raised == lowered >= 0.9 * len(problems)

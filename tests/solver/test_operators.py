"""Hessian products against torch.func.hessian, Lanczos and damping against eigvalsh."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest
import torch

from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Iterate, LinearSolver, Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping, lanczos, random_start
from neural_sim.solver.direct import Exact, Identity
from neural_sim.solver.hvp import HessianOperator, gradient
from neural_sim.solver.operator import Shifted, columns, flatten, unflatten

DOUBLE = torch.float64
MODES = ["reverse_over_reverse", "central_difference"]


@pytest.fixture
def network(generator):
    """A small network's parameters and its loss terms over uneven chunks of inputs."""

    def draw(*shape: int):
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    params = {"in": draw(3, 4), "bias": draw(4), "out": draw(4, 2)}
    inputs, targets = draw(7, 3), draw(7, 2)

    def term(x, y):
        def loss(p):
            out = torch.nn.functional.silu(x @ p["in"] + p["bias"]) @ p["out"]
            return torch.logaddexp(out, -y * out).sum() / 7

        return loss

    terms = [term(x, y) for x, y in zip(inputs.split(3), targets.split(3), strict=True)]
    return params, terms


def dense_hessian(params, terms):
    return torch.func.hessian(lambda flat: sum(term(unflatten(flat, params)) for term in terms))(
        flatten(params)
    )


@pytest.mark.parametrize(("mode", "retain"), [(mode, False) for mode in MODES] + [(MODES[0], True)])
def test_hessian_products_equal_the_dense_hessian(network, mode, retain):
    params, terms = network
    operator = HessianOperator(terms, params, mode, retain_graph=retain)
    tolerance = 1e-7 if mode == "central_difference" else 1e-12
    torch.testing.assert_close(operator.dense(), dense_hessian(params, terms), rtol=tolerance, atol=tolerance)
    b = gradient(terms, params)
    solution = Exact().solve(Shifted(operator, 9.0), b, rtol=1e-6)
    expected = torch.linalg.solve(dense_hessian(params, terms) + 9.0 * torch.eye(len(b), dtype=DOUBLE), b)
    torch.testing.assert_close(solution.value, expected, rtol=10 * tolerance, atol=10 * tolerance)
    assert solution.products == len(b) + 1


def test_central_difference_is_scale_free(network):
    params, terms = network
    operator = HessianOperator(terms, params, "central_difference")
    vector = random_start(operator.size, torch.Generator().manual_seed(3), dtype=DOUBLE)
    for scale in (1e-20, 1e20):
        torch.testing.assert_close(operator(scale * vector) / scale, operator(vector), rtol=1e-7, atol=1e-8)
    assert operator(torch.zeros_like(vector)).norm() == 0.0


def test_gradient_equals_autograd_and_chunks_do_not_matter(network):
    params, terms = network
    reference = torch.func.grad(lambda flat: sum(term(unflatten(flat, params)) for term in terms))(
        flatten(params)
    )
    torch.testing.assert_close(gradient(terms, params), reference)


@pytest.mark.parametrize("mode", MODES)
def test_linear_and_constant_terms_have_no_curvature(mode):
    params = {"a": torch.ones(3, dtype=DOUBLE), "unused": torch.ones(2, dtype=DOUBLE)}
    terms = [lambda p: p["a"].sum(), lambda p: (p["a"] * 0.0).sum() + 1.0]
    product = HessianOperator(terms, params, mode)(torch.ones(5, dtype=DOUBLE))
    assert product.norm() < 1e-8


def test_a_product_evaluates_the_loss_once(network):
    params, terms = network
    calls = 0

    def counted(p):
        nonlocal calls
        calls += 1
        return terms[0](p)

    HessianOperator([counted], params)(flatten(params))
    assert calls == 1


def test_flatten_round_trip(network):
    params, _ = network
    back = unflatten(flatten(params), params)
    assert list(back) == list(params)
    assert all(torch.equal(back[key], params[key]) for key in params)
    with pytest.raises(ValueError, match="want"):
        unflatten(torch.zeros(3), params)
    with pytest.raises(ValueError, match="no parameters"):
        flatten({})


def test_operators_refuse_nonsense(network):
    params, terms = network
    with pytest.raises(ValueError, match="mode"):
        HessianOperator(terms, params, "sideways")
    with pytest.raises(ValueError, match="terms"):
        HessianOperator([], params)


def test_lanczos_finds_the_extreme_eigenvalues(generator):
    matrix = torch.randn(40, 40, generator=generator, dtype=DOUBLE)
    matrix = matrix + matrix.T
    values = torch.linalg.eigvalsh(matrix)
    full = lanczos(lambda v: matrix @ v, random_start(40, generator, dtype=DOUBLE), 100)
    assert full.products == 40
    assert full.smallest == pytest.approx(float(values[0]), rel=1e-10)
    assert full.largest == pytest.approx(float(values[-1]), rel=1e-10)
    few = lanczos(lambda v: matrix @ v, random_start(40, generator, dtype=DOUBLE), 12)
    assert float(values[0]) - 1e-12 <= few.smallest and few.largest <= float(values[-1]) + 1e-12
    for ritz, error in ((few.smallest, few.smallest_error), (few.largest, few.largest_error)):
        assert float((values - ritz).abs().min()) <= error + 1e-12


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_lanczos_in_any_unit(scale, dtype, generator):
    diagonal = torch.tensor([-1.0, 0.5, 2.0, 2.0, 7.0], dtype=dtype) * scale
    spectrum = lanczos(lambda v: diagonal * v, random_start(5, generator, dtype=dtype), 5)
    assert spectrum.smallest == pytest.approx(-scale, rel=1e-4)
    assert spectrum.largest == pytest.approx(7 * scale, rel=1e-4)


def test_lanczos_on_one_unknown_zero_and_non_finite_operators(generator):
    one = lanczos(lambda v: -3.0 * v, torch.ones(1, dtype=DOUBLE), 10)
    assert (one.smallest, one.largest, one.products) == (-3.0, -3.0, 1)
    zero = lanczos(lambda v: 0.0 * v, torch.ones(4, dtype=DOUBLE), 10)
    assert (zero.smallest, zero.largest) == (0.0, 0.0)
    bad = lanczos(lambda v: math.nan * v, torch.ones(4, dtype=DOUBLE), 10)
    assert not bad.finite and (bad.smallest, bad.largest) == (0.0, 0.0)
    with pytest.raises(ValueError, match="non-zero"):
        lanczos(lambda v: v, torch.zeros(2), 3)
    with pytest.raises(ValueError, match="steps"):
        lanczos(lambda v: v, torch.ones(2), 0)


@pytest.mark.parametrize("low", [-5.0, -1e-3, 0.0, 1e-4, 1.0])
def test_lanczos_damping_bounds_the_condition_number(low, generator):
    values = torch.linspace(low, 10.0, 30, dtype=DOUBLE)
    choice = LanczosDamping(max_condition=50.0, lanczos_steps=30).choose(
        lambda v: values * v, torch.ones(30, dtype=DOUBLE), generator
    )
    damped = values + choice.value
    assert float(damped.min()) > 0.0
    assert float(damped.max() / damped.min()) <= 50.0 * (1 + 1e-9)
    assert choice.condition == pytest.approx(float(damped.max() / damped.min()), rel=1e-6)
    assert choice.value >= 1.25 * max(0.0, -low) * (1 - 1e-9)


@pytest.mark.parametrize("steps", [2, 4, 6])
def test_damping_allows_for_the_error_of_the_smallest_ritz_value(steps, generator):
    """Ritz pairs of a dense basis of the Krylov space, and the norms of their residuals."""
    matrix, b = torch.diag(torch.linspace(-5.0, 10.0, 30, dtype=DOUBLE)), torch.ones(30, dtype=DOUBLE)
    powers = torch.stack([torch.linalg.matrix_power(matrix / 10.0, power) @ b for power in range(steps)], 1)
    basis, _ = torch.linalg.qr(powers)
    values, inside = torch.linalg.eigh(basis.T @ matrix @ basis)
    vectors = basis @ inside
    least = float(values[0] - (matrix @ vectors[:, 0] - values[0] * vectors[:, 0]).norm())
    wanted = max(-1.25 * least, (float(values[-1]) - 50.0 * least) / 49.0)
    choice = LanczosDamping(max_condition=50.0, lanczos_steps=steps).choose(matrix.mv, b, generator)
    assert choice.value == pytest.approx(wanted, rel=1e-8)


def test_damping_of_a_non_finite_operator_is_its_minimum(generator):
    choice = LanczosDamping(minimum=0.125).choose(
        lambda v: v * math.nan, torch.ones(3, dtype=DOUBLE), generator
    )
    assert choice.value == 0.125


@pytest.mark.parametrize("damping", [FixedDamping(0.7), LanczosDamping()])
def test_adjoint_solves_the_damped_system(network, damping, generator):
    params, terms = network
    b = gradient(terms, params)
    solver = AdjointSolver(ConjugateGradient(), damping, rtol=1e-10, max_steps=500)
    adjoint = solver.solve(terms, params, b, None, generator)
    operator = solver.operator(terms, params)
    matrix = columns(operator, b)
    eye = torch.eye(b.numel(), dtype=DOUBLE)
    reference = torch.linalg.solve(matrix + adjoint.damping.value * eye, b)
    assert adjoint.solution.status is Status.CONVERGED
    torch.testing.assert_close(adjoint.vector, reference, rtol=1e-7, atol=1e-8)


@dataclass(frozen=True)
class Counting(AdjointSolver):
    """Keeps a record of every Hessian product, whatever asked for it."""

    products: list[int] = field(default_factory=list)

    def operator(self, terms, params):
        product = super().operator(terms, params)

        def counted(vector):
            self.products.append(1)
            return product(vector)

        return counted


def test_damping_is_raised_until_conjugate_gradients_hold(generator):
    """One negative eigenvalue among very many near zero: too few Lanczos steps do not see it."""
    values = torch.cat(
        [torch.linspace(0.0, 1e-2, 397, dtype=DOUBLE), torch.tensor([-2.0, 60.0, 150.0], dtype=DOUBLE)]
    )
    params = {"w": torch.zeros(400, dtype=DOUBLE)}
    terms = [lambda p: 0.5 * (values * p["w"].square()).sum()]
    b = torch.randn(400, generator=generator, dtype=DOUBLE)
    damping = LanczosDamping(max_condition=1e3, lanczos_steps=2)
    solver = Counting(ConjugateGradient(), damping, rtol=1e-8)
    adjoint = solver.solve(terms, params, b, None, generator)
    assert adjoint.damping_raises >= 1
    assert adjoint.solution.products + adjoint.damping.spectrum.products == len(solver.products)
    assert adjoint.solution.status is Status.CONVERGED
    torch.testing.assert_close(adjoint.vector, b / (values + adjoint.damping.value), rtol=1e-6, atol=1e-7)
    fixed = AdjointSolver(ConjugateGradient(), FixedDamping(0.1, 0), rtol=1e-8).solve(
        terms, params, b, None, generator
    )
    assert (
        fixed.solution.status is Status.NEGATIVE_CURVATURE
        and fixed.damping_raises == 0
        and fixed.damping.value == 0.1
    )


def test_a_multiple_of_the_right_hand_side_needs_no_damping(network, generator):
    params, terms = network
    b = gradient(terms, params)
    solver = Counting(Identity(2.0))
    found = solver.solve(terms, params, b, None, generator)
    torch.testing.assert_close(found.vector, 2.0 * b)
    assert found.damping.value == 0.0 and found.damping.spectrum is None
    assert len(solver.products) == 1  # of the residual
    product = HessianOperator(terms, params)(2.0 * b)
    assert found.solution.residual == pytest.approx(float((b - product).norm() / b.norm()))


@dataclass(frozen=True)
class Looking(LinearSolver):
    """Looks along the first axis alone, and says whether its curvature is negative."""

    def iterate(self, system):
        product = system.operator.measured(torch.eye(len(system.rhs), dtype=DOUBLE)[0])
        status = Status.NEGATIVE_CURVATURE if product.energy < 0.0 else Status.MAX_STEPS
        return Iterate(torch.zeros_like(system.rhs), status, 1)


def test_damping_is_raised_by_the_curvature_of_the_loss_without_damping(generator):
    """The right-hand side has no part along the eigenvalue -2, so lambda starts at (3 - 2 * 1) / (2 - 1) = 1.

    Along it, the damped curvature is -1 and the loss's is -2: (3 + 2 * 2) / (2 - 1) = 7 bounds the condition by 2.
    """
    values, b = torch.tensor([-2.0, 1.0, 3.0], dtype=DOUBLE), torch.tensor([0.0, 1.0, 1.0], dtype=DOUBLE)
    solver = AdjointSolver(Looking(), LanczosDamping(max_condition=2.0))
    terms, params = [lambda p: 0.5 * values @ p["w"].square()], {"w": torch.zeros(3, dtype=DOUBLE)}
    found = solver.solve(terms, params, b, None, generator)
    assert found.damping_raises == 1 and found.damping.value == pytest.approx(7.0)


def test_damping_of_a_zero_right_hand_side(network, generator):
    params, terms = network
    zero = torch.zeros_like(flatten(params))
    adjoint = AdjointSolver().solve(terms, params, zero, None, generator)
    assert adjoint.solution.status is Status.CONVERGED and adjoint.vector.norm() == 0.0

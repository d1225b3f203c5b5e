"""Solves against dense oracles: the oracle itself against torch, orders of the solvers, products."""

import math
from dataclasses import replace

import pytest
import torch

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.damping import FixedDamping
from neural_sim.solver.direct import Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.studies.stress.linear import relative
from neural_sim.studies.work_precision import solver as family
from neural_sim.studies.work_precision.measurement import Timing
from neural_sim.studies.work_precision.solver import Inverse, Oracle, Solver, product_problem

SOLVERS = {
    "cg": AdjointSolver(), "minres": AdjointSolver(MinimumResidual()), "identity": AdjointSolver(Identity()),
}  # fmt: skip


def micro(num_classes, image_size):
    return RetinaNet(
        num_classes, image_size, Backbone("micro"), Head(8, 1), Anchors(sizes=((14,), (28,)), reference=48)
    )


class Quadratic:
    """A loss whose Hessian is a chosen matrix with eigenvalues 1, ..., 20."""

    def __init__(self):
        generator = torch.Generator().manual_seed(0)
        basis, _ = torch.linalg.qr(torch.randn(20, 20, generator=generator, dtype=torch.float64))
        self.hessian = basis * torch.arange(1.0, 21.0, dtype=torch.float64) @ basis.T
        self.anchor = {"theta": torch.zeros(20, dtype=torch.float64)}
        self.b = torch.randn(20, generator=generator, dtype=torch.float64)

    @property
    def inner(self):
        weights = torch.ones(1, dtype=torch.float64)
        return InnerProblem(
            self.anchor, lambda p, rows: 0.5 * (p["theta"] @ self.hessian @ p["theta"]).expand(1), weights
        )

    @property
    def validation(self):
        return [lambda p: self.b @ p["theta"]]


def test_the_oracle_is_the_dense_solve():
    problem = Quadratic()
    oracle = Oracle.of(problem.inner.terms(), problem.anchor, problem.b)
    truth = torch.linalg.solve(problem.hessian + 0.5 * torch.eye(20, dtype=torch.float64), problem.b)
    assert relative(oracle.solve(0.5), truth) < 20 * 20 * 41 * 2.3e-16  # n^2 times condition times eps
    assert torch.allclose(oracle.values, torch.arange(1.0, 21.0, dtype=torch.float64), rtol=1e-12)


@pytest.fixture(scope="module")
def inverse():
    problem = Quadratic()
    solvers = Solver(SOLVERS, steps=(4, 25), rtols=(1e-9,), conditions=())
    measured = solvers._inverse(Inverse.of(problem.inner, problem.validation, Timing(1), 0))
    return {series.name: series for series in measured}


def test_solves_by_steps_end_by_their_steps_and_a_krylov_space_of_full_size_solves(inverse):
    own, *given = inverse.values()
    assert own.name == "solver/damping of its own" and len(given) == 2
    for series in given:
        error = {point.setting: point.error for point in series.points}
        for name in ("cg", "minres"):
            assert error[f"{name}, 25 steps"] < 1e-9 < 1e-3 < error[f"{name}, 4 steps"]
        assert error["identity"] > 0.1
        assert {point.line for point in series.points} == {"cg", "minres", "identity"}
        assert not any(point.default for point in series.points)


def test_the_default_is_the_solver_as_it_is_configured(inverse):
    own = inverse["solver/damping of its own"]
    (default,) = [point for point in own.points if point.default]
    # The residual is at most rtol |b|: the error at most that times the condition number, 20 / 1.
    assert default.setting == "cg, rtol 0.03" and default.error < 0.03 * 20
    error = {point.setting: point.error for point in own.points}
    assert error["cg, rtol 1e-09"] < 1e-9 * 20 and error["cg, graph built anew, rtol 1e-09"] < 1e-9 * 20
    # Differences of gradients are known to eps^(2/3) = 4e-11, times the condition number.
    assert error["cg, central differences, rtol 1e-09"] < 1e-7


def test_a_solver_with_another_damping_says_so():
    """Its error is that of another system, as measured at the lambda of the default."""
    problem = Quadratic()
    solvers = {
        "cg": AdjointSolver(damping=FixedDamping(0.5, 0)),
        "more": AdjointSolver(damping=FixedDamping(2.0, 0)),
    }
    inverse = Inverse.of(problem.inner, problem.validation, Timing(1), 0)
    own = next(iter(Solver(solvers, rtols=(1e-9,), steps=(1,), conditions=())._inverse(inverse)))
    details = {point.setting: point.detail for point in own.points}
    assert (
        details["more, rtol 1e-09"].endswith(", at lambda = 2") and "lambda" not in details["cg, rtol 1e-09"]
    )


def test_linear_systems_are_solved_to_their_tolerance_times_the_condition():
    (series,) = Solver(SOLVERS, conditions=(1e2,)).measure(None, Timing(1), 0)
    error = {point.setting: point.error for point in series.points}
    for name in ("cg", "minres"):
        for rtol in (1e-2, 1e-6, 1e-10):
            assert error[f"{name}, rtol {rtol:g}"] <= rtol * 1e2
    assert error["dense"] < 200 * 200 * 1e2 * 2.3e-16


def test_products_in_float32_against_float64():
    terms, params, precise = product_problem(micro, 3, 48, 0)
    names = family.PRODUCTS
    assert math.isclose(float(sum(t(params) for t in terms)), float(sum(t({n: v.double() for n, v in params.items()})
                        for t in precise)), rel_tol=1e-4)  # fmt: skip
    series = Solver(SOLVERS, timed=micro, images=3, size=48, conditions=())._products(micro, Timing(1), 0)
    error = {point.setting: point.error for point in series.points}
    assert set(error) == set(names)
    # Central differences in float32 lose a third of the digits: eps^(2/3) = 2.4e-5 times the loss's third derivative.
    assert error["graph kept"] < 1e-4 and error["graph built anew"] < 1e-4 < 0.1
    assert error["central differences"] < 0.1
    assert [point.setting for point in series.points if point.default] == ["graph kept"]


def test_bad_settings_name_their_key():
    with pytest.raises(ValueError, match=r"work_precision\.solver\.default"):
        Solver(SOLVERS, default="gmres")
    with pytest.raises(ValueError, match=r"Solver\."):
        replace(Solver(SOLVERS), steps=(0,))

"""What every solver does with extreme, singular, non-finite and senseless input: a status or a clear refusal."""

from __future__ import annotations

import math

import pytest
import torch

from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.exact import Exact
from neural_sim.solver.identity import Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.neumann import Neumann
from neural_sim.solver.nystrom import Nystrom
from neural_sim.solver.operator import norm
from neural_sim.solver.solution import Status

DOUBLE = torch.float64
SIZE = 24
ALL = [
    ConjugateGradient(),
    MinimumResidual(),
    Neumann(),
    Nystrom(shift=0.5),
    Nystrom(shift=0.5, sketch="gaussian", refine=False),
    Identity(),
    Exact(),
    Exact(method="cholesky"),
]
# Those whose settings carry no unit of the operator, unlike a fixed scale or shift.
WITHOUT_UNIT = [solver for solver in ALL if not isinstance(solver, Identity | Nystrom)]


def name(solver) -> str:
    return repr(solver)


@pytest.mark.parametrize("solver", ALL, ids=name)
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_right_hand_sides_of_any_size_solve_alike(solver, dtype, scale, symmetric, right_hand_side, spread):
    matrix, b = symmetric(0.5 + spread(1e1)).to(dtype), right_hand_side().to(dtype)
    plain = solver.solve(lambda v: matrix @ v, b, rtol=1e-4, max_steps=200)
    scaled = solver.solve(lambda v: matrix @ v, b * scale, rtol=1e-4, max_steps=200)
    assert scaled.status is plain.status
    assert scaled.residual == pytest.approx(plain.residual, rel=0.1, abs=1e-5)
    torch.testing.assert_close(scaled.value / scale, plain.value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("solver", WITHOUT_UNIT, ids=name)
@pytest.mark.parametrize("scale", [1e-200, 1e-12, 1e12, 1e200])
def test_residual_does_not_change_with_the_operators_unit(solver, scale, symmetric, right_hand_side, spread):
    matrix, b = symmetric(0.5 + spread(1e1)), right_hand_side()
    plain = solver.solve(lambda v: matrix @ v, b, rtol=1e-5, max_steps=200)
    scaled = solver.solve(lambda v: scale * (matrix @ v), b, rtol=1e-5, max_steps=200)
    assert (scaled.status, scaled.steps) == (plain.status, plain.steps)
    assert scaled.residual == pytest.approx(plain.residual, rel=1e-2, abs=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_norms_of_any_size(dtype):
    unit = torch.tensor([3.0, -4.0, 0.0], dtype=dtype)
    for power in (-1000, -600, -120, 0, 120, 600, 1000):
        if abs(power) < 126 or dtype is DOUBLE:
            assert norm(unit * 2.0**power) == 5.0 * 2.0**power
    assert norm(torch.zeros(3, dtype=dtype)) == 0.0
    assert math.isnan(norm(unit * math.nan)) and norm(unit[:2] * math.inf) == math.inf


@pytest.mark.parametrize("solver", ALL, ids=name)
def test_zero_right_hand_side_is_solved_by_zero(solver):
    solution = solver.solve(lambda v: v * math.nan, torch.zeros(3), x0=torch.ones(3))
    assert solution.status is Status.CONVERGED
    assert solution.value.norm() == 0.0 and solution.residual == 0.0


@pytest.mark.parametrize("solver", ALL, ids=name)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_inputs_give_a_status(solver, bad):
    for solution in (
        solver.solve(lambda v: v * bad, torch.ones(3, dtype=DOUBLE)),
        solver.solve(lambda v: v, torch.tensor([1.0, bad, 0.0], dtype=DOUBLE)),
    ):
        assert solution.status is Status.NON_FINITE
        assert torch.isfinite(solution.value).all() and math.isfinite(solution.residual)
        assert all(math.isfinite(end) for end in solution.curvature)


@pytest.mark.parametrize("solver", WITHOUT_UNIT, ids=name)
@pytest.mark.parametrize("entry", [3.0, 1e-300, 1e-20, 1e20, 1e300])
def test_one_unknown(solver, entry):
    solution = solver.solve(lambda v: entry * v, torch.tensor([6.0], dtype=DOUBLE), rtol=1e-6)
    assert solution.status is Status.CONVERGED
    assert solution.value.item() == pytest.approx(6.0 / entry)


@pytest.mark.parametrize("solver", ALL, ids=name)
def test_zero_operator_gives_a_status(solver):
    solution = solver.solve(lambda v: 0.0 * v, torch.ones(1, dtype=DOUBLE))
    assert not solution.status.trusted
    assert torch.isfinite(solution.value).all() and solution.residual == pytest.approx(1.0)


@pytest.mark.parametrize("solver", WITHOUT_UNIT, ids=name)
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("condition", [1e10, 1e12, 1e16])
def test_hopeless_systems_are_never_claimed_solved(
    solver, dtype, condition, symmetric, right_hand_side, spread
):
    matrix, b = symmetric(spread(condition)).to(dtype), right_hand_side().to(dtype)
    rtol = 1e-10 if dtype is DOUBLE else 1e-5
    solution = solver.solve(lambda v: matrix @ v, b, rtol=rtol, max_steps=100)
    assert torch.isfinite(solution.value).all() and solution.residual <= 1.0
    true = float((b.double() - matrix.double() @ solution.value.double()).norm() / b.double().norm())
    # rounding of one product: n eps |A| |x| / |b|
    slack = SIZE * torch.finfo(dtype).eps * float(solution.value.double().norm() / b.double().norm())
    assert solution.residual == pytest.approx(true, abs=slack + 1e-15)
    if solution.status.trusted:
        assert solution.residual <= rtol


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"b": torch.ones(2, 2)}, "vector"),
        ({"b": torch.ones(0)}, "non-empty"),
        ({"b": torch.ones(2, dtype=torch.long)}, "floating"),
        ({"b": torch.ones(2), "x0": torch.ones(3)}, "x0"),
        ({"b": torch.ones(2), "rtol": 2.0}, "rtol"),
        ({"b": torch.ones(2), "max_steps": 0}, "max_steps"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ConjugateGradient().solve(lambda v: v, **arguments)


def test_a_wrong_operator_or_size_is_refused():
    with pytest.raises(ValueError, match="product of shape"):
        ConjugateGradient().solve(lambda v: v[:1], torch.ones(3))
    with pytest.raises(ValueError, match="max_size"):
        Exact(max_size=2).solve(lambda v: v, torch.ones(3))

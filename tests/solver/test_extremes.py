"""What every solver does with extreme, singular, non-finite and senseless input: a status or a clear refusal."""

from __future__ import annotations

import math

import pytest
import torch

from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.direct import Exact, Identity
from neural_sim.solver.minres import MinimumResidual
from neural_sim.solver.operator import norm

DOUBLE = torch.float64
SIZE = 24
ALL = [ConjugateGradient(), MinimumResidual(), Identity(), Exact()]
# Those whose settings carry no unit of the operator, unlike a fixed scale.
WITHOUT_UNIT = [solver for solver in ALL if not isinstance(solver, Identity)]


def name(solver) -> str:
    return repr(solver)


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
    if solution.status is Status.CONVERGED:
        assert solution.residual <= rtol


@pytest.mark.usefixtures("wrong_shapes")
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

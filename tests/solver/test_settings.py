"""The solver's settings have ranges, and a value out of one is refused by its key."""

import math

import pytest

from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping, LanczosDamping
from neural_sim.solver.direct import Exact, Identity
from neural_sim.solver.minres import MinimumResidual

CASES = [
    (FixedDamping, {"value": -1.0}, "FixedDamping.value: want at least 0, got -1.0"),
    (FixedDamping, {"value": math.nan}, "FixedDamping.value: want at least 0 and finite, got nan"),
    (FixedDamping, {"value": math.inf}, "FixedDamping.value: want at least 0 and finite, got inf"),
    (LanczosDamping, {"margin": 0.0}, "LanczosDamping.margin: want more than 0"),
    (LanczosDamping, {"max_condition": 1.0}, "LanczosDamping.max_condition: want more than 1"),
    (LanczosDamping, {"lanczos_steps": 0}, "LanczosDamping.lanczos_steps: want at least 1"),
    (ConjugateGradient, {"restart_gain": 1.0}, "ConjugateGradient.restart_gain: want more than 0 and less than 1"),
    (MinimumResidual, {"restart_gain": 0.0}, "MinimumResidual.restart_gain: want more than 0 and less than 1"),
    (Identity, {"scale": 0.0}, "Identity.scale: want a number other than 0"),
    (Exact, {"max_size": 0}, "Exact.max_size: want at least 1"),
    (AdjointSolver, {"rtol": 1.0}, "AdjointSolver.rtol: want at least 0 and less than 1"),
    (AdjointSolver, {"max_raises": -1}, "AdjointSolver.max_raises: want at least 0"),
    (AdjointSolver, {"mode": "sideways"}, "AdjointSolver.mode: want one of reverse_over_reverse, central_difference"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)

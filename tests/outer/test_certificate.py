"""What a step's certificate doubts, what follows from it, and how it is told."""

import dataclasses
import math

import pytest
import torch

from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.outer.certificate import certify, line, untrusted
from neural_sim.outer.retrained import Check, FiniteDifference
from neural_sim.settings import Trust
from neural_sim.solver.damping import Damped
from neural_sim.solver.lanczos import Spectrum
from neural_sim.solver.solution import Solution, Status

SPECTRUM = Spectrum(-1.0, 9.0, 0.1, 0.1, 12, True)
STRICT = Trust(max_stationarity=2.0, max_sensitivity=0.5, min_cosine=0.5)


def result(
    gradient=(1.0, -1.0), snr=((3.0, 0.2), (0.5, 0.4)), status=Status.CONVERGED, residual=0.01, **changes
):
    names = ("a", "b")
    made = Hypergradient(
        psi_gradients={name: torch.tensor(gradient) for name in names},
        standard_errors={name: torch.ones(2) for name in names},
        signal_to_noise={name: torch.tensor(row) for name, row in zip(names, snr, strict=True)},
        solution=Solution(torch.ones(3), status, 7, residual, (0.1, 9.0), 8, False),
        damping=Damped(3.0, SPECTRUM), sensitivity=0.2, stationarity=1.5, validation_norm=2.5, raises=1,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def checked(cosine):
    return Check(cosine, 0, FiniteDifference(torch.zeros(2), True, 1e-9, 3, 100))


def judge(found, cosine=None, trust=STRICT, on_untrusted="shrink"):
    return certify(found, ("a", "b"), None if cosine is None else checked(cosine), trust, on_untrusted)


def test_a_good_step_is_kept_with_everything_recorded():
    certificate = judge(result(), cosine=0.8)
    assert certificate.doubts == [] and certificate.action == "kept"
    assert (
        certificate.solver_status == "CONVERGED" and certificate.solver_steps == 7 and certificate.raises == 1
    )
    assert (certificate.curvature_min, certificate.curvature_max, certificate.damping) == (-1.0, 9.0, 3.0)
    assert certificate.condition == pytest.approx(12.0 / 2.0)
    assert certificate.signal_to_noise == [pytest.approx([3.0, 0.2]), pytest.approx([0.5, 0.4])]
    assert (certificate.cosine, certificate.sensitivity, certificate.stationarity) == (0.8, 0.2, 1.5)


@pytest.mark.parametrize(
    ("found", "cosine", "doubt"),
    [
        (result(residual=0.2, status=Status.MAX_STEPS), None, "residual"),
        (result(status=Status.NEGATIVE_CURVATURE), None, "solver"),
        (result(stationarity=2.1), None, "stationarity"),
        (result(sensitivity=0.6), None, "sensitivity"),
        (result(snr=((0.9, 0.2), (0.5, 0.4))), None, "signal"),
        (result(), 0.4, "cosine"),
    ],
)
@pytest.mark.parametrize(
    ("on_untrusted", "action"),
    [("shrink", "shrunk"), ("keep", "kept"), ("skip", "skipped"), ("stop", "stopped")],
)
def test_each_demand_is_doubted_by_name_and_handled_as_configured(found, cosine, doubt, on_untrusted, action):
    certificate = judge(found, cosine, on_untrusted=on_untrusted)
    assert certificate.doubts == [doubt] and certificate.action == action
    free = Trust(None, None, None, None, None)
    assert judge(found, cosine, free).doubts == (["solver"] if doubt == "solver" else [])


def test_what_does_not_exist_is_not_doubted():
    certificate = judge(result(sensitivity=math.nan, damping=Damped(3.0, None)))
    assert certificate.doubts == [] and math.isnan(certificate.condition) and math.isnan(certificate.cosine)
    assert judge(result(status=Status.APPROXIMATE, residual=5.0)).doubts == []
    assert judge(result(), cosine=math.nan).doubts == []


def test_a_gradient_that_is_not_finite_is_never_followed():
    actions = {"shrink": "skipped", "keep": "skipped", "skip": "skipped", "stop": "stopped"}
    for on_untrusted, action in actions.items():
        certificate = judge(result(gradient=(math.nan, 0.0)), on_untrusted=on_untrusted)
        assert certificate.action == action and "not finite" in certificate.doubts


def test_a_step_is_told_in_one_line():
    text = line(judge(result(stationarity=3.0), cosine=0.8), 3, 14, 0.25)
    assert "\n" not in text
    for part in (
        "psi 3/14",
        "CONVERGED 7 steps",
        "cond 6",
        "snr 3.0/0.5",
        "cos 0.80",
        "shrunk (stationarity)",
    ):
        assert part in text
    assert "cos" not in line(judge(result()), 1, 2, 0.1)


def test_steps_that_were_not_trusted_are_counted():
    certificates = [judge(result(), 0.9), judge(result(stationarity=9.0), 0.1), judge(result(residual=0.5))]
    records = [{"certificate": dataclasses.asdict(certificate)} for certificate in certificates]
    assert untrusted(records) == {
        "steps": 3, "untrusted": 2, "actions": {"shrunk": 2},
        "doubts": {"stationarity": 1, "cosine": 1, "residual": 1}, "cosines": [0.9, 0.1],
    }  # fmt: skip
    assert untrusted([])["untrusted"] == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_residual": -1.0}, "outer.trust.max_residual"),
        ({"min_cosine": 2.0}, "outer.trust.min_cosine"),
        ({"shrink": 1.0}, "outer.trust.shrink"),
    ],
)
def test_thresholds_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Trust(**changes)

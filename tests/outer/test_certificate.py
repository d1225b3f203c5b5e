"""What an iteration's certificate doubts, what follows from it for each object's step, and how it is told."""

import dataclasses
import math
from collections import Counter

import pytest
import scipy.stats
import torch

from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.hypergradient import Hypergradient, ImplicitAdjoint, UnrolledAdjoint
from neural_sim.gradient.implicit import Implicit
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.outer.certificate import Trust, certify, line, untrusted
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.solver.base import Solution, Status
from neural_sim.solver.damping import Damped, Spectrum
from neural_sim.types import SceneDraw

SPECTRUM = Spectrum(-1.0, 9.0, 0.1, 0.1, 12, True)
STRICT = Implicit()
FREE = Implicit(max_residual=None)


def result(gradient=(1.0, -1.0), p_values=(0.01, 0.04), status=Status.CONVERGED, residual=0.01, **changes):
    names = ("a", "b")
    solution = Solution(torch.ones(3), status, 7, residual, (0.1, 9.0), 8, False)
    adjoint = ImplicitAdjoint(solution, Damped(3.0, SPECTRUM), 1, 1.5, 2.5)
    return Hypergradient(
        gradients={name: torch.tensor(gradient) for name in names},
        errors={name: torch.ones(2) for name in names},
        adjoint=dataclasses.replace(adjoint, **changes),
        p_values={name: {"pose": p} for name, p in zip(names, p_values, strict=True)},
    )


def judge(found, cosine=None, on_untrusted="shrink", level=0.1, min_cosine=0.5, adjoint=STRICT):
    trust = Trust(level, min_cosine, on_untrusted)
    return certify(found, found.p_values, ("a", "b"), ("pose",), trust, adjoint, cosine)


def actions(certificate):
    return [certificate.actions[name]["pose"] for name in ("a", "b")]


def test_a_good_step_is_kept_with_everything_recorded():
    certificate = judge(result(), cosine=0.8)
    assert certificate.doubts == [] and actions(certificate) == ["kept", "kept"]
    assert not certificate.void
    adjoint = certificate.adjoint
    assert (adjoint.solver_status, adjoint.solver_steps, adjoint.damping_raises) == ("CONVERGED", 7, 1)
    assert (adjoint.curvature_min, adjoint.curvature_max, adjoint.damping) == (-1.0, 9.0, 3.0)
    assert adjoint.condition == pytest.approx(12.0 / 2.0)
    assert certificate.p_values == {"a": {"pose": 0.01}, "b": {"pose": 0.04}}
    assert (certificate.cosine, adjoint.stationarity) == (0.8, 1.5)


@pytest.mark.parametrize(
    ("found", "cosine", "doubt"),
    [
        (result(residual=0.2, status=Status.MAX_STEPS), None, "residual"),
        (result(status=Status.NEGATIVE_CURVATURE), None, "solver"),
        (result(), 0.4, "cosine"),
    ],
)
@pytest.mark.parametrize(
    ("on_untrusted", "action"),
    [("shrink", "shrunk"), ("keep", "taken"), ("skip", "skipped")],
)
def test_a_doubt_about_all_is_named_and_handled_as_configured_for_every_object(
    found, cosine, doubt, on_untrusted, action
):
    certificate = judge(found, cosine, on_untrusted=on_untrusted)
    assert certificate.doubts == [doubt] and actions(certificate) == [action] * 2
    assert certificate.void == (action not in ("shrunk", "taken"))
    free = judge(found, cosine, level=None, min_cosine=None, adjoint=FREE)
    assert free.doubts == (["solver"] if doubt == "solver" else [])


@pytest.mark.parametrize(
    ("p_values", "on_untrusted", "expected"),
    [
        ((0.1, 0.101), "shrink", ["kept", "shrunk"]),
        ((0.9, 0.001), "skip", ["skipped", "kept"]),
        ((0.9, 0.2), "shrink", ["shrunk", "shrunk"]),
        ((0.9, 0.001), "keep", ["taken", "kept"]),
        ((0.9, 0.2), "skip", ["skipped", "skipped"]),
    ],
)
def test_an_object_without_signal_holds_up_no_other(p_values, on_untrusted, expected):
    """What was skipped for want of signal joins the momentum."""
    certificate = judge(result(p_values=p_values), on_untrusted=on_untrusted)
    assert certificate.doubts == [] and actions(certificate) == expected
    assert not certificate.void
    assert actions(judge(result(p_values=p_values), level=None)) == ["kept", "kept"]


def test_each_factor_is_judged_by_itself():
    found = result()
    found.p_values["a"]["zoom"], found.p_values["b"]["zoom"] = 0.5, 0.02
    certificate = certify(found, found.p_values, ("a", "b"), ("pose", "zoom"), Trust(), STRICT)
    assert certificate.actions == {
        "a": {"pose": "kept", "zoom": "skipped"},
        "b": {"pose": "kept", "zoom": "kept"},
    }


def test_only_objects_that_move_have_actions_and_what_was_not_tested_is_kept():
    found = dataclasses.replace(result(), p_values={})
    certificate = certify(found, found.p_values, ("b",), ("pose",), Trust(), STRICT)
    assert certificate.actions == {"b": {"pose": "kept"}} and certificate.p_values == {}


@pytest.mark.slow
def test_of_six_objects_that_know_nothing_and_one_that_does_the_one_is_kept(generator):
    """The default estimator's own p-values, 50 iterations: noise is kept with the probability that the level says."""
    each, level, runs = 16, 0.05, 50
    bins = torch.arange(8).repeat_interleave(each)
    distribution = SceneDistribution.of([Pose()])
    still = torch.zeros(len(bins))
    batch = ObjectImages(
        torch.zeros(8, dtype=torch.float64), distribution, torch.zeros(len(bins), 3, 1, 1), torch.arange(len(bins)),
        torch.full((len(bins),), 1.0 / len(bins)), SceneDraw(still, still, still, bins[:, None]),
    )  # fmt: skip

    def scores_are_the_vector(params, index):
        return params["w"][index]

    losses = Losses(scores_are_the_vector, None, scores_are_the_vector)
    params = {"w": torch.zeros(len(bins), dtype=torch.float64)}
    names, kept = [f"noise {i}" for i in range(6)] + ["planted"], Counter()
    for _ in range(runs):
        noise = torch.randn(7, len(bins), generator=generator, dtype=torch.float64)
        # Heavy tails, and bins that scatter up to four times as much as others.
        noise = noise / torch.randn(2, 7, len(bins), generator=generator).norm(dim=0) * (1 + bins / 2)
        noise[-1] += 30.0 * (bins == 2)
        probes = {"pose": Probes(torch.arange(len(bins)), bins)}
        estimates = [
            StratifiedEstimator(each).estimate(losses, params, {"w": s}, batch, probes) for s in noise
        ]
        found = dataclasses.replace(
            result(),
            gradients={name: part.value for name, part in zip(names, estimates, strict=True)},
            p_values={name: part.p_values for name, part in zip(names, estimates, strict=True)},
        )
        certificate = certify(found, found.p_values, names, ("pose",), Trust(level), STRICT)
        assert certificate.doubts == []
        kept.update(name for name in names if certificate.actions[name]["pose"] == "kept")
    wrongly = sum(kept[name] for name in names[:-1])
    assert wrongly <= scipy.stats.binom.ppf(1 - 1e-4, 6 * runs, level)
    assert kept["planted"] == runs


def test_what_does_not_exist_is_not_doubted():
    certificate = judge(result(damping=Damped(3.0, None)))
    assert certificate.doubts == [] and certificate.adjoint.condition is None and certificate.cosine is None
    assert judge(result(status=Status.APPROXIMATE, residual=5.0)).doubts == []


def test_each_adjoint_has_a_record_of_its_own_and_what_was_compared_has_none():
    unrolled = dataclasses.replace(result(), adjoint=UnrolledAdjoint(60, True, 2.5))
    certificate = judge(unrolled, adjoint=Unrolled())
    assert certificate.doubts == [] and dataclasses.asdict(certificate.adjoint) == {
        "validation_norm": 2.5, "reversed_steps": 60,
    }  # fmt: skip
    assert "reversed 60 steps" in line(certificate, 1, 2, 0.1)
    broken = dataclasses.replace(result(), adjoint=UnrolledAdjoint(60, False, 2.5))
    assert judge(broken, adjoint=Unrolled()).doubts == ["solver"]
    compared = judge(dataclasses.replace(result(), adjoint=None))
    assert compared.doubts == [] and compared.adjoint is None


def test_a_gradient_that_is_not_finite_is_never_followed():
    for on_untrusted in ("shrink", "keep", "skip"):
        certificate = judge(result(gradient=(math.nan, 0.0)), on_untrusted=on_untrusted)
        assert actions(certificate) == ["skipped"] * 2 and "not finite" in certificate.doubts
        assert certificate.void


def test_a_step_is_told_in_one_line():
    text = line(judge(result(residual=0.3), cosine=0.8), 3, 14, 0.25)
    assert "\n" not in text
    for part in (
        "psi 3/14",
        "CONVERGED 7 steps",
        "cond 6",
        "p pose 0.01/0.04",
        "cos 0.80",
        "shrunk 2 (residual)",
    ):
        assert part in text
    assert line(judge(result(p_values=(0.3, 0.01))), 1, 2, 0.1).endswith("; shrunk 1, kept 1")
    assert "cos" not in line(judge(result()), 1, 2, 0.1)


def test_steps_that_were_not_trusted_are_counted():
    certificates = [
        judge(result(), 0.9),
        judge(result(status=Status.NON_FINITE), 0.1),
        judge(result(residual=0.5, p_values=(0.3, 0.01))),
        judge(result(p_values=(0.3, 0.01)), on_untrusted="skip").waiting({("a", "pose"), ("b", "pose")}),
    ]
    records = [
        {"certificate": dataclasses.asdict(certificate), "verdicts": {}, "taken_back": {}}
        for certificate in certificates
    ]
    back = {"kept": 1, "accepted": 3, "gain": 0.02}
    records.append({"certificate": None, "verdicts": {}, "taken_back": {"a": back}})
    assert untrusted(records) == {
        "steps": 8, "waited": 1, "untrusted": 5, "actions": {"shrunk": 4, "skipped": 1},
        "doubts": {"solver": 2, "cosine": 2, "residual": 2, "signal": 1},
        "judged": 0, "rejected": 0, "taken_back": {"a": back}, "cosines": [0.9, 0.1],
    }  # fmt: skip
    assert untrusted([])["untrusted"] == 0


def test_steps_that_are_taken_in_spite_of_doubts_are_not_counted_as_trusted():
    certificates = [
        judge(result(residual=0.2, status=Status.MAX_STEPS), on_untrusted="keep"),
        judge(result(p_values=(0.3, 0.01)), on_untrusted="keep"),
    ]
    records = [
        {"certificate": dataclasses.asdict(certificate), "verdicts": {}, "taken_back": {}}
        for certificate in certificates
    ]
    counted = untrusted(records)
    assert counted["untrusted"] == 3 and counted["actions"] == {"taken": 3}
    assert counted["doubts"] == {"residual": 2, "signal": 1}
    assert not any(certificate.void for certificate in certificates)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"min_cosine": 2.0}, "Trust.min_cosine"),
        ({"shrink": 1.0}, "Trust.shrink"),
        ({"level": 1.0}, "Trust.level"),
        ({"level": 1e-6}, "Trust.level"),
    ],
)
def test_thresholds_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Trust(**changes)


@pytest.mark.parametrize("key", ["curvature_images", "max_residual"])
def test_limits_of_the_adjoint_that_make_no_sense_are_refused(key):
    with pytest.raises(ValueError, match=f"Implicit.{key}"):
        Implicit(**{key: -1})

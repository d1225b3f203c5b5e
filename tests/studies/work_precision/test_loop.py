"""Whole methods: errors and seconds of runs whose curves are known, and when half of the gap was won back."""

import math

import pytest

from neural_sim.studies.work_precision.loop import half, seconds_to_half, series


def run(method, seed, aps, seconds, learned, loss=1.0, objective="ap"):
    """A run with ns at 0.2 and matched at 0.8: half of the gap is at 0.5."""

    def scores(ap):
        return {"ap": ap, "per_class": {"can": ap, "mug": ap, "rest": 0.0}}

    curve = [
        {"iteration": i, "seconds": s, "cpu_seconds": 2.0 * s, "ap": scores(ap)}
        for i, (ap, s) in enumerate(zip(aps, seconds, strict=True))
    ]
    return {
        "method": method, "seed": seed, "biased": ["can", "mug"], "curve": curve,
        "ap": {"ns": scores(0.2), "matched": scores(0.8)},
        "config": {"outer": {"objective": objective}},
        "iterations": [{"validation_loss": 9.0}, {"validation_loss": loss}],
        "total_variation": {name: {"pose": {"initial": 0.8, "learned": learned}} for name in ("can", "mug", "rest")},
    }  # fmt: skip


FAST = [
    run("neural_sim", 0, (0.2, 0.5, 0.7), (0.0, 10.0, 20.0), 0.1),
    run("neural_sim", 1, (0.2, 0.4, 0.5), (0.0, 12.0, 24.0), 0.3),
]
SLOW = [run("lts", 0, (0.2, 0.3, 0.4), (0.0, 50.0, 100.0), 0.5, loss=2.0)]


def test_every_method_has_errors_against_the_seconds_it_took():
    ap, loss, away = series("pose_gap", [*FAST, *SLOW], "neural_sim", "seconds")
    points = {point.setting: point for point in ap.points}
    assert points["neural_sim, 1 iterations"].error == pytest.approx(1.0 - 0.45)
    assert points["neural_sim, 2 iterations"].seconds == pytest.approx(22.0)
    assert points["lts, 2 iterations"].error == pytest.approx(0.6)
    assert [name for name, point in points.items() if point.default] == ["neural_sim, 2 iterations"]
    assert points["neural_sim, 2 iterations"].detail == "half the gap: 17 s, in 2 of 2"
    assert points["lts, 2 iterations"].detail == "half the gap: never in 1"
    assert [(p.setting, p.error) for p in loss.points] == [("neural_sim", 1.0), ("lts", 2.0)]
    assert [p.error for p in away.points] == pytest.approx([0.2, 0.5]) and away.pareto == (True, False)
    assert ap.name == "loop/pose_gap, AP"


def test_validation_losses_of_two_objectives_are_not_compared():
    other = run("auto_sim", 0, (0.2, 0.4), (0.0, 5.0), 0.5, loss=0.1, objective="loss")
    _, first, second, _ = series("pose_gap", [*FAST, other], "neural_sim", "seconds")
    assert (first.name, second.name) == ("loop/pose_gap, objective ap", "loop/pose_gap, objective loss")
    assert first.pareto == (True,) and [p.error for p in second.points] == [0.1]


def test_half_of_the_gap_by_either_clock():
    assert seconds_to_half(FAST[0], "seconds") == 10.0 and seconds_to_half(FAST[0], "cpu_seconds") == 20.0
    assert math.isinf(seconds_to_half(SLOW[0], "seconds"))
    assert half([FAST[0], SLOW[0]], "seconds") == "half the gap: 10 s, in 1 of 2"


def test_a_run_without_a_gap_wins_nothing_back():
    same = {**FAST[0], "ap": {"ns": FAST[0]["ap"]["matched"], "matched": FAST[0]["ap"]["ns"]}}
    assert math.isinf(seconds_to_half(same, "seconds"))

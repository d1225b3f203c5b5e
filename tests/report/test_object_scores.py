"""AP by object and method, beside the comparison of means, which resamples the same seeds and images."""

import dataclasses

import numpy as np
import pytest
from finished_runs import finished

from neural_sim.report.bootstrap import average_precision
from neural_sim.report.object_scores import MEAN, object_scores
from neural_sim.report.statistics import compare

CURVE = [
    {"images": n, "detector_steps": n, "products": 0, "seconds": float(n), "cpu_seconds": float(n),
     "ap": {"per_class": {"can": 0.1, "mug": 0.1}}}
    for n in (0, 1, 2)
]  # fmt: skip


def runs(*methods, seeds=(0, 1)):
    return [
        finished({"ns": (0.2, 0.4), "learned": (ap, ap + 0.1 * seed), "matched": (0.8, 0.9)},
                 experiment="gap", method=method, seed=seed, curve=CURVE)
        for method, ap in methods for seed in seeds
    ]  # fmt: skip


def test_scores_do_not_need_a_known_target():
    made = runs(("neural_sim", 0.7), ("lts", 0.3))
    bare = [
        dataclasses.replace(r, matches={w: m for w, m in r.matches.items() if w != "matched"}) for r in made
    ]
    found, beside = (object_scores(each, "neural_sim", draws=10) for each in (bare, made))
    assert found.methods == ("ns", "lts", "neural_sim") == beside.methods[:-1]
    assert found.ahead["lts"] == beside.ahead["lts"]


def test_objects_have_their_own_ap_and_their_mean_is_that_of_the_comparison():
    made = runs(("neural_sim", 0.7), ("lts", 0.3), ("auto_sim", 0.5))
    found = object_scores(made, "neural_sim", draws=40)
    assert found.methods == ("ns", "lts", "auto_sim", "neural_sim", "matched")
    assert found.objects == ("can", "mug") and found.rows == ("can", "mug", MEAN) and found.seeds == (0, 1)
    for place, name in enumerate(found.objects):
        each = [average_precision(run.matches["learned"][place]) for run in made if run.method == "lts"]
        assert found.ap["lts"][name].value == pytest.approx(np.mean(each), abs=1e-12)
        assert found.ap["lts"][name].low <= found.ap["lts"][name].value <= found.ap["lts"][name].high
    assert found.ap["ns"]["can"].value == pytest.approx(0.2, abs=0.01)
    compared = compare(made, "neural_sim", draws=40)
    for method in ("ns", "lts", "auto_sim", "neural_sim", "matched"):
        mean, other = found.ap[method][MEAN], compared.ap[method]
        assert (mean.value, mean.low, mean.high) == pytest.approx(
            (other.value, other.low, other.high), abs=1e-12
        )
    for method in ("lts", "auto_sim"):
        ahead, other = found.ahead[method][MEAN], compared.ahead[method]
        assert (ahead.value, ahead.low, ahead.high) == pytest.approx(
            (other.value, other.low, other.high), abs=1e-12
        )


def test_a_method_is_ahead_of_itself_by_nothing_in_every_draw():
    """Differences are paired: equal detections differ in no resampled set, though their AP does."""
    found = object_scores(runs(("neural_sim", 0.5), ("lts", 0.5)), "neural_sim", draws=30)
    for name in found.rows:
        ahead = found.ahead["lts"][name]
        assert (ahead.value, ahead.low, ahead.high) == (0.0, 0.0, 0.0)
        assert found.ap["lts"][name].low < found.ap["lts"][name].high


def test_a_missing_seed_is_refused():
    made = [*runs(("neural_sim", 0.7)), *runs(("lts", 0.3), seeds=(0,))]
    with pytest.raises(ValueError, match=r"lacking \['lts seed 1'\]"):
        object_scores(made, "neural_sim", draws=5)

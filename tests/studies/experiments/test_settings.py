"""Which runs are the settings of an experiment: those of this scale, of the newest way of scoring."""

import numpy as np
import pytest
from finished_runs import BUDGET, finished, results

from neural_sim.report.comparison import compare
from neural_sim.report.runs import FinishedRun, Group, Runs
from neural_sim.report.score_table import average_precision
from neural_sim.studies.experiments.settings import MEAN, Setting, Settings, modes


def run(number, method="neural_sim", size=1, budget=BUDGET, **more):
    made = results("gap", method, 0, **more)
    config = {**made["config"], "views": {"size": size}, "budget": budget}
    scoring = f"{made['scoring']} {size}"
    return FinishedRun({**made, "config": config, "scoring": scoring}, f"{method}", f"{number:08d}x", "gap")


def read(*runs):
    return Settings("", BUDGET, "neural_sim", 5, 0).groups(Runs(runs))


def test_starts_and_targets_are_settings_of_one_way_of_scoring():
    groups, left_out = read(run(3), run(2, gap="uniform"), run(1, target=2), run(0, "lts"))
    found = {(group.runs[0].results["gap"], group.runs[0].results["scoring"]) for group in groups}
    assert len(found) == 3 and not left_out
    (disjoint,) = [group for group in groups if len(group.runs) == 2]
    assert [each.method for each in disjoint.runs] == ["neural_sim", "lts"]


def test_runs_of_another_scale_and_of_an_older_way_of_scoring_are_left_out():
    small = {**BUDGET, "outer": {"iterations": 2}}
    groups, left_out = read(run(9, budget=small), run(3), run(2, gap="uniform", size=7))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"]
    reasons = {left.run_id: left.reason for left in left_out}
    assert reasons == {
        "00000009x": "it was run at another scale",
        "00000002x": "newer runs of the experiment are scored in another way",
    }


def test_a_run_from_before_a_key_of_budget_is_of_this_scale():
    before = dict(list(BUDGET.items())[1:])
    groups, left_out = read(run(3, budget=before))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"] and not left_out
    assert not read(run(3, budget={**BUDGET, "gone": 1}))[0] and not read(run(3, budget={}))[0]


def test_distributions_in_short():
    assert modes([0.125] * 8) == "uniform"
    assert modes([0.86, *[0.02] * 7]) == "1"
    assert modes([0.02, *[0.14] * 7]) == "2, 3, 4, 5, 6, 7, 8"
    assert modes([0.44, 0.02, 0.02, 0.02, 0.02, 0.44, 0.02, 0.02]) == "1, 6"


CURVE = [
    {"images": n, "detector_steps": n, "products": 0, "seconds": float(n), "cpu_seconds": float(n),
     "ap": {"per_class": {"can": 0.1, "mug": 0.1}}}
    for n in (0, 1, 2)
]  # fmt: skip


def scored(*methods, draws, seeds=(0, 1), known=("ns", "learned", "matched")):
    runs = []
    for method, ap in methods:
        for seed in seeds:
            each = {"ns": (0.2, 0.4), "learned": (ap, ap + 0.1 * seed), "matched": (0.8, 0.9)}
            rows = {which: each[which] for which in known}
            runs.append(finished(rows, experiment="gap", method=method, seed=seed, curve=CURVE))
    return Setting.of(Group("gap", "gap", "", tuple(runs)), "neural_sim", draws)


def ends(estimate):
    return estimate.value, estimate.low, estimate.high


def test_scores_do_not_need_a_known_target():
    methods = ("neural_sim", 0.7), ("lts", 0.3)
    bare, made = scored(*methods, draws=10, known=("ns", "learned")), scored(*methods, draws=10)
    assert bare.methods == ["ns", "lts", "neural_sim"] == made.methods[:-1]
    for name in ("can", "mug", MEAN):
        assert bare.ahead("lts", name) == made.ahead("lts", name)


def test_objects_have_their_own_ap_and_their_mean_is_that_of_the_comparison():
    made = scored(("neural_sim", 0.7), ("lts", 0.3), ("auto_sim", 0.5), draws=40)
    assert made.methods == ["ns", "lts", "auto_sim", "neural_sim", "matched"]
    assert made.objects == ("can", "mug") and made.seeds == "0, 1"
    for place, name in enumerate(made.objects):
        each = [
            average_precision(run.outcomes["learned"][place])
            for run in made.group.runs
            if run.method == "lts"
        ]
        found = made.score("lts", name)
        assert (
            found.value == pytest.approx(np.mean(each), abs=1e-12) and found.low <= found.value <= found.high
        )
    assert made.score("ns", "can").value == pytest.approx(0.2, abs=0.01)
    compared = compare(made.group.runs, "neural_sim", draws=40)
    for method in ("ns", "lts", "auto_sim", "neural_sim", "matched"):
        assert ends(made.score(method)) == pytest.approx(ends(compared.ap[method]), abs=1e-12)
    for method in ("lts", "auto_sim"):
        assert ends(made.ahead(method)) == pytest.approx(ends(compared.ahead[method]), abs=1e-12)


def test_a_method_is_ahead_of_itself_by_nothing_in_every_draw():
    """Differences are paired: equal detections differ in no resampled set, though their AP does."""
    made = scored(("neural_sim", 0.5), ("lts", 0.5), draws=30)
    for name in (*made.objects, MEAN):
        assert ends(made.ahead("lts", name)) == (0.0, 0.0, 0.0)
        assert made.score("lts", name).low < made.score("lts", name).high

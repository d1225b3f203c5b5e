"""Which runs are the settings of an experiment: those of this scale, of the newest way of scoring."""

import pytest
from finished_runs import BUDGET, results

from neural_sim.report import settings as module
from neural_sim.report.finished import Candidate
from neural_sim.report.settings import Settings, modes


def run(number, method="neural_sim", size=1, budget=BUDGET, **more):
    made = results("gap", method, 0, **more)
    config = {**made["config"], "views": {"size": size}, "budget": budget}
    scoring = f"{made['scoring']} {size}"
    return Candidate(f"{method}", f"{number:08d}x", "gap", {**made, "config": config, "scoring": scoring})


@pytest.fixture
def read(monkeypatch):
    def reads(*runs):
        monkeypatch.setattr(module.logged, "experiments", lambda uri: ["gap", "other"])
        monkeypatch.setattr(
            module, "candidates", lambda uri, names: [r for r in runs if r.experiment in names]
        )
        return Settings("", BUDGET, "neural_sim", 5, 0).groups(["gap", "absent"])

    return reads


def test_starts_and_targets_are_settings_of_one_way_of_scoring(read):
    groups, left_out = read(run(3), run(2, gap="uniform"), run(1, target=2), run(0, "lts"))
    found = {(group.runs[0].results["gap"], group.runs[0].results["scoring"]) for group in groups}
    assert len(found) == 3 and not left_out
    (disjoint,) = [group for group in groups if len(group.runs) == 2]
    assert [each.method for each in disjoint.runs] == ["neural_sim", "lts"]


def test_runs_of_another_scale_and_of_an_older_way_of_scoring_are_left_out(read):
    small = {**BUDGET, "outer": {"iterations": 2}}
    groups, left_out = read(run(9, budget=small), run(3), run(2, gap="uniform", size=7))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"]
    reasons = {left.run_id: left.reason for left in left_out}
    assert reasons == {
        "00000009x": "it was run at another scale",
        "00000002x": "newer runs of the experiment are scored in another way",
    }


def test_a_run_from_before_a_key_of_budget_is_of_this_scale(read):
    before = dict(list(BUDGET.items())[1:])
    groups, left_out = read(run(3, budget=before))
    assert [group.runs[0].run_id for group in groups] == ["00000003x"] and not left_out
    assert not read(run(3, budget={**BUDGET, "gone": 1}))[0] and not read(run(3, budget={}))[0]


def test_distributions_in_short():
    assert modes([0.125] * 8) == "uniform"
    assert modes([0.86, *[0.02] * 7]) == "1"
    assert modes([0.02, *[0.14] * 7]) == "2, 3, 4, 5, 6, 7, 8"
    assert modes([0.44, 0.02, 0.02, 0.02, 0.02, 0.44, 0.02, 0.02]) == "1, 6"

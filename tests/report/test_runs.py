"""Which of some made-up runs are compared, and what is said of the others."""

import pytest

from neural_sim.report.runs import FinishedRun, Runs, select

CONFIG = {
    **{group: {"size": 1} for group in (
        "objects", "views", "field", "renderer", "synthesis", "unlearned", "target", "detector", "training")},
    "parameter": {"pose": {"bins": 8, "floor": 0.005}},
}  # fmt: skip


def made(
    method, seed, number, scoring="s", configuration=None, test_set=None, gap="disjoint", config=(), **more
):
    """A run; ``number`` is its id, ``config`` what its configuration has otherwise."""
    results = {
        "experiment": "pose_gap", "gap": gap, "method": method, "seed": seed, "biased": ["mug"], "curve": [{}],
        "scoring": scoring, "configuration": configuration or method, "test_set": test_set or f"images of {seed}",
        "config": {**CONFIG, **dict(config)}, "files": {"objects": {"mug": "1" * 64}},
        "code": {"scoring": "a" * 12, "method": "b" * 12}, **more,
    }  # fmt: skip
    return FinishedRun(results, f"{method} seed {seed}", f"{number:08d}x", "pose_gap")


def selected(runs, *arguments):
    return select(Runs(tuple(runs)), *arguments)


def reasons(left_out):
    return {run.run_id.lstrip("0")[:-1]: run.reason for run in left_out}


def chosen(group):
    return [(run.method, run.seed, run.run_id.lstrip("0")[:-1]) for run in group.runs]


SMALL = {"views": {"size": 0}, "training": {"size": 0}}


def test_a_later_smoke_run_replaces_no_real_one():
    real = [made("ours", 0, 1), made("lts", 0, 2)]
    smoke = [made("lts", 0, 9, scoring="t", config=SMALL)]
    (group,), left_out = selected([*smoke, *real], "ours")
    assert chosen(group) == [("ours", 0, "1"), ("lts", 0, "2")]
    assert (group.setting, group.label, group.heading, group.seeds) == ("pose_gap", "pose_gap", "", (0,))
    assert reasons(left_out) == {
        "9": "no run of ours is scored in the same way; compared with ours seed 0 (00000001), views.size is 0, not 1; "
        "training.size is 0, not 1"
    }


def test_runs_scored_in_two_ways_are_two_tables_that_say_what_differs():
    real = [made("ours", 0, 1), made("lts", 0, 2)]
    smoke = [made("ours", 0, 8, scoring="t", config=SMALL), made("lts", 0, 9, scoring="t", config=SMALL)]
    groups, left_out = selected([*smoke, *real], "ours")
    assert [chosen(group) for group in groups] == [
        [("ours", 0, "8"), ("lts", 0, "9")], [("ours", 0, "1"), ("lts", 0, "2")],
    ]  # fmt: skip
    assert [group.heading for group in groups] == [
        "views.size=0, training.size=0", "views.size=1, training.size=1",
    ]  # fmt: skip
    assert len({group.label for group in groups}) == 2 and not left_out


def test_gaps_are_settings_of_their_own():
    found = [made("ours", 0, 1), made("ours", 0, 2, scoring="u", gap="uniform")]
    assert [group.label for group in selected(found, "ours")[0]] == ["pose_gap", "pose_gap, uniform"]


def test_a_methods_runs_share_the_settings_of_the_newest():
    found = [
        made("ours", 1, 5), made("lts", 1, 4), made("lts", 0, 3),
        made("lts", 0, 2, configuration="other", config={"baseline": {"learning_rate": 2}}), made("ours", 0, 1),
    ]  # fmt: skip
    groups, left_out = selected(found, "ours")
    assert chosen(groups[0]) == [
        ("ours", 0, "1"),
        ("ours", 1, "5"),
        ("lts", 0, "3"),
        ("lts", 1, "4"),
    ]
    assert reasons(left_out)["2"].startswith(
        "its settings are not those of the newest run of lts, lts seed 1 (00000004): baseline.learning_rate is 2"
    )


def test_of_equal_runs_the_newest_counts():
    groups, left_out = selected([made("ours", 0, 2), made("ours", 0, 1)], "ours")
    assert chosen(groups[0]) == [("ours", 0, "2")]
    assert reasons(left_out) == {
        "1": "a newer run of the same settings and seed replaces it, ours seed 0 (00000002)"
    }


def test_methods_of_a_seed_share_its_test_set():
    floor = {"parameter": {"pose": {"bins": 8, "floor": 0.1}}}
    found = [
        made("lts", 0, 5, test_set="others"), made("lts", 0, 4), made("lts", 1, 3, test_set="others"),
        made("search", 0, 6, test_set="others", config=floor), made("ours", 1, 2), made("ours", 0, 1),
    ]  # fmt: skip
    groups, left_out = selected(found, "ours")
    assert chosen(groups[0]) == [("ours", 0, "1"), ("lts", 0, "4")]
    told = reasons(left_out)
    assert told["5"].startswith(
        "its test images or labels are not those of ours seed 0 (00000001): the settings are"
    )
    assert told["6"].endswith("(00000001): parameter.pose.floor is 0.1, not 0.005")
    assert "test images" in told["3"] and told["2"] == "there is no run of seed 1 of lts"


def test_seeds_that_a_method_lacks_are_named():
    found = [made("ours", s, s + 1) for s in range(3)] + [made("lts", s, s + 11) for s in (1, 2, 4)]
    groups, left_out = selected([*found, made("rare", 7, 20), made("rarer", 0, 21)], "ours")
    assert groups[0].seeds == (1, 2)
    assert reasons(left_out) == {
        "20": "ours has no run of seed 7", "15": "ours has no run of seed 4", "1": "there is no run of seed 0 of lts",
        "21": "no seed is common to it and ours, lts",
    }  # fmt: skip


def test_a_method_of_one_seed_takes_no_seeds_from_those_that_are_named():
    found = [
        made("ours", 0, 1),
        made("ours", 1, 2),
        made("lts", 0, 3),
        made("lts", 1, 4),
        made("response", 0, 5),
    ]
    (narrow,), _ = selected(found, "ours")
    assert narrow.seeds == (0,)
    (group,), left_out = selected(found, "ours", ["lts"])
    assert [(m, seed) for m, seed, _ in chosen(group)] == [("ours", 0), ("ours", 1), ("lts", 0), ("lts", 1)]
    assert reasons(left_out) == {"5": "compare.methods does not name its method"}


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (FinishedRun(name="x", run_id="9x", unusable="its status in MLflow is FAILED"), "status in MLflow is FAILED"),
        (made("lts", 0, 9, scoring=None), "an older version wrote it"),
        (made("lts", 0, 9, biased=[]), "all its objects start from the target"),
        (made("oracle", 0, 9), "rows ns and matched"),
    ],
)  # fmt: skip
def test_runs_that_cannot_be_compared_are_named_with_the_reason(run, reason):
    groups, left_out = selected([run, made("ours", 0, 1)], "ours")
    assert chosen(groups[0]) == [("ours", 0, "1")]
    assert reason in reasons(left_out)["9"]


def test_without_the_reference_there_is_nothing_to_compare():
    groups, left_out = selected([made("lts", 0, 1)], "ours")
    assert not groups and reasons(left_out) == {"1": "ours has no run of this setting"}
    assert selected([made("oracle", 0, 1)], "oracle")[0][0].runs

"""Comparisons and costs on made-up runs whose answers are known: who is ahead, by how much, whether it is certain."""

import dataclasses
import json
import math

import numpy as np
import pytest
from finished_runs import finished

from neural_sim.report.comparison import (
    ONLY_AT_END,
    SECONDS,
    ap_at,
    area_under,
    biased_ap,
    compare,
    costs,
    costs_table,
)
from neural_sim.report.intervals import points
from neural_sim.report.runs import FinishedRun
from neural_sim.report.score_table import THRESHOLDS, Matches
from neural_sim.studies.compare import markdown

IMAGES = 100


def matches(share, seed=0):
    """One box an image, ``share`` of them found at every overlap and nothing else: AP is about that share."""
    random = np.random.default_rng(seed)
    found = np.sort(random.permutation(IMAGES)[: round(share * IMAGES)])
    correct = np.ones((len(found), len(THRESHOLDS)), dtype=bool)
    return [Matches(found, correct, np.ones(IMAGES, dtype=int))]


def run(method, seed, learned, seconds=(10.0, 100.0)):
    curve = [
        {
            "seconds": s, "cpu_seconds": 100.0 - s, "images": 10 * s, "detector_steps": 1, "products": 0,
            "ap": {"per_class": {"mug": ap}},
        }
        for s, ap in zip((0.0, *seconds), (0.2, *(0.5 * (0.2 + learned), learned)[-len(seconds) :]), strict=True)
    ]  # fmt: skip
    results = {
        "method": method, "seed": seed, "experiment": "gap", "gap": "disjoint", "biased": ["mug"], "curve": curve,
    }  # fmt: skip
    held = {"ns": matches(0.2), "learned": matches(learned, seed), "matched": matches(0.8)}
    return FinishedRun(results, read=lambda: held)


def with_outcomes(each, held):
    return dataclasses.replace(each, read=lambda: held)


def test_shares_won_back_and_leads_are_those_of_the_runs():
    runs = [run("ours", s, 0.7) for s in range(3)] + [run("other", s, 0.4) for s in range(3)]
    found = compare(runs, "ours", draws=50)
    assert found.methods == ("ours", "other") and found.seeds == (0, 1, 2)
    assert found.ap["ours"].value == pytest.approx(0.7, abs=0.01)
    assert found.won_back["ours"].value == pytest.approx(0.5 / 0.6, abs=0.02)
    assert found.ahead["other"].value == pytest.approx(0.3, abs=0.01) and found.ahead["other"].certain
    assert found.ap["ours"].low < found.ap["ours"].value < found.ap["ours"].high
    assert found.spent["other"] == {
        "images": 1000.0,
        "detector_steps": 1.0,
        "products": 0.0,
        "seconds": 100.0,
    }


def test_leads_do_not_need_a_known_target():
    runs = [run(method, s, ap) for s in range(3) for method, ap in (("ours", 0.7), ("other", 0.4))]
    bare = [with_outcomes(r, {w: m for w, m in r.outcomes.items() if w != "matched"}) for r in runs]
    found, beside = compare(bare, "ours", draws=50), compare(runs, "ours", draws=50)
    assert found.bounds == ["ns"] and beside.bounds == ["ns", "matched"] and found.won_back == {}
    assert found.ahead == beside.ahead and found.ap == {m: e for m, e in beside.ap.items() if m != "matched"}


def test_no_fraction_is_closed_where_there_is_no_gap():
    runs = [run(method, s, ap) for s in range(3) for method, ap in (("ours", 0.2), ("other", 0.3))]
    at_target = [with_outcomes(r, {**r.outcomes, "matched": r.outcomes["ns"]}) for r in runs]
    found = compare(at_target, "ours", draws=50)
    assert found.won_back == {} and found.ahead["other"].value == pytest.approx(-0.1, abs=0.01)
    assert "nan" not in markdown(found, [_with_distances(each) for each in at_target])
    json.dumps(dataclasses.asdict(found), allow_nan=False)


def test_a_lead_that_hangs_on_the_seed_is_not_certain():
    runs = [run("ours", s, ap) for s, ap in enumerate((0.3, 0.7, 0.5))]
    runs += [run("other", s, ap) for s, ap in enumerate((0.6, 0.4, 0.5))]
    assert not compare(runs, "ours", draws=100).ahead["other"].certain


def test_only_seeds_that_all_methods_have_are_compared():
    runs = [run("ours", s, 0.7) for s in (0, 1)] + [run("other", s, 0.4) for s in (1, 2)]
    assert compare(runs, "ours", draws=5).seeds == (1,)
    with pytest.raises(ValueError, match="no seed is common"):
        compare([run("ours", 0, 0.7), run("other", 1, 0.4)], "ours", draws=5)
    with pytest.raises(ValueError, match="no run of 'ours'"):
        compare([run("other", 0, 0.4)], "ours", draws=5)


def test_the_area_is_the_mean_over_log_seconds_of_what_was_reached():
    seconds, ap = np.asarray([0.0, 10.0, 100.0]), np.asarray([0.2, 0.5, 0.8])
    assert area_under(seconds, ap, 1.0, 100.0) == pytest.approx((0.2 + 0.65) / 2)  # a decade each
    assert area_under(seconds, ap, 10.0, 1000.0) == pytest.approx((0.65 + 0.8) / 2)
    assert area_under(seconds, ap, 100.0, 1000.0) == pytest.approx(0.8)
    assert area_under(seconds, ap, 1.0, 9.0) == pytest.approx(0.2)
    assert area_under(np.zeros(1), ap[:1], 1.0, 100.0) == 0.2  # nothing was learned


@pytest.mark.parametrize(("first", "ratio"), [(0.5, 4.0), (0.5, 1e4), (5.0, 30.0), (20.5, 1.1), (400.0, 2.0)])
def test_the_area_is_the_mean_of_ap_at_all_budgets(first, ratio):
    seconds, ap = np.asarray([0.0, 3.0, 20.0, 21.0, 300.0]), np.asarray([0.1, 0.1, 0.6, 0.4, 0.9])
    budgets = np.exp(np.linspace(math.log(first), math.log(first * ratio), 20_001))
    reached = [ap_at(seconds, ap, budget) for budget in budgets]
    assert area_under(seconds, ap, first, first * ratio) == pytest.approx(np.mean(reached), abs=1e-3)


def test_ap_at_a_budget_lies_on_the_line_between_scored_points():
    seconds, ap = np.asarray([0.0, 10.0, 1000.0]), np.asarray([0.2, 0.5, 0.9])
    assert (
        ap_at(seconds, ap, 5.0) == 0.2 and ap_at(seconds, ap, 10.0) == 0.5
    )  # a point's own seconds reach it
    assert ap_at(seconds, ap, 2000.0) == 0.9
    assert ap_at(seconds, ap, 100.0) == pytest.approx(0.7)  # the middle of two decades
    assert ap_at(np.asarray([0.0]), np.asarray([0.2]), 10.0) == 0.2


def test_all_methods_are_read_at_the_cost_of_the_cheapest():
    runs = [run("ours", s, 0.7, (10.0, 100.0)) for s in range(3)]
    runs += [run("other", s, 0.8, (200.0, 1000.0)) for s in range(3)]
    found = compare(runs, "ours", draws=20)
    assert found.equal_cost == 100.0
    assert found.at_equal_cost["ours"].value == pytest.approx(0.7)
    assert found.at_equal_cost["other"].value == pytest.approx(0.2)  # its first iteration is not done by then
    assert "AP after 100 seconds" in markdown(found, [_with_distances(each) for each in runs])


def test_leads_by_budget_reach_from_the_first_scored_iteration_of_any_run_to_the_last():
    runs = [run("ours", s, 0.7, (10.0, 100.0)) for s in range(3)]
    runs += [run("other", s, 0.5 + 0.2 * s, (100.0, 1000.0)) for s in range(3)]
    found = compare(runs, "ours", draws=50)
    np.testing.assert_allclose(found.budgets, np.geomspace(10.0, 1000.0, 6))
    leads = found.ahead_at["other"]
    # Ours has 0.45 after 10 s and 0.7 after 100; the other 0.2 before 100 s, then 0.45 and 0.7 on average over seeds.
    assert [lead.value for lead in leads] == pytest.approx([0.25, 0.35, 0.45, 0.2, 0.1, 0.0])
    assert leads[0].certain and leads[0].low == pytest.approx(0.25) and not leads[-1].certain
    text = markdown(found, [_with_distances(each) for each in runs])
    assert "| ours ahead after (seconds), of | 10 | 25 | 63 | 158 | 398 | 1000 |" in text
    assert "| other | **25.0** (25.0 to 25.0) | **35.0** (35.0 to 35.0) | " in text


def test_runs_that_were_scored_once_do_not_tell_who_is_ahead_before():
    """Their leads are not in bold, and a line says why; the lead at the end is."""
    runs = [run("ours", s, 0.7, (100.0,)) for s in range(3)] + [run("other", s, 0.4) for s in range(3)]
    found = compare(runs, "ours", draws=20)
    assert found.only_at_end and found.ahead_at["other"][0].certain  # 0.2 until its end, behind 0.3
    text = markdown(found, [_with_distances(each) for each in runs])
    assert text.count("**") == 2 and ONLY_AT_END in text
    on_the_way = compare([run(m, s, 0.5) for s in range(3) for m in ("ours", "other")], "ours", draws=20)
    assert not on_the_way.only_at_end


def test_one_method_alone_leads_nobody():
    found = compare([run("ours", 0, 0.7)], "ours", draws=5)
    assert found.ahead_at == {} and "ahead after" not in markdown(
        found, [_with_distances(run("ours", 0, 0.7))]
    )


def _with_distances(each):
    distances = {"mug": {"pose": {"initial": 0.8, "learned": 0.1}}}
    more = {"iterations": [], "total_variation": distances, "config": {"trainer": {"accelerator": "cpu"}}}
    return dataclasses.replace(each, results={**each.results, **more})


def test_who_reaches_the_same_sooner_has_the_larger_area():
    runs = [run("ours", s, 0.7, (1.0, 10.0)) for s in range(2)] + [run("other", s, 0.7) for s in range(2)]
    found = compare(runs, "ours", draws=20)
    # Over two decades from 1 to 100 s: ours rises from 0.45 to 0.7 and stays, the other has 0.2 and then rises so.
    assert found.area["other"].value == pytest.approx(0.25) and found.area["other"].certain
    np.testing.assert_allclose(biased_ap(runs[0], "seconds")[1], [0.2, 0.45, 0.7])


def test_the_area_of_one_seed_has_no_interval_and_is_never_certain():
    found = compare([run("ours", 0, 0.7, (1.0, 10.0)), run("other", 0, 0.7)], "ours", draws=5).area["other"]
    assert found.value == pytest.approx(0.25) and (found.low, found.high, found.certain) == (
        None,
        None,
        False,
    )
    assert points(found, sure=True) == "25.0"


def test_processor_time_is_another_clock():
    runs = [run("ours", 0, 0.7, (10.0, 90.0)), run("other", 0, 0.4, (10.0, 20.0))]
    found = compare(runs, "ours", draws=5, clock="cpu_seconds")
    assert found.spent["ours"]["cpu_seconds"] == 10.0 and "seconds" not in found.spent["ours"]
    np.testing.assert_allclose(biased_ap(runs[1], "cpu_seconds")[0], [100.0, 90.0, 80.0])


AP = {"ns": (0.2, 0.2), "learned": (0.5, 0.5), "matched": (0.9, 0.9)}


def record(norms=(), errors=(), **seconds):
    return {"seconds": seconds, "gradient_norms": list(norms), "gradient_errors": list(errors)}


def spender(method, records, seconds, images=30, **more):
    curve = [{"images": 0, "seconds": 0.0}, {"images": images, "seconds": seconds}]
    return finished(AP, experiment="gap", method=method, seed=0, iterations=records, curve=curve, **more)


def test_seconds_by_phase_add_up_to_what_the_method_is_charged():
    records = [
        record(pool=4.0, probes=1.0, render=2.0, features=3.0, train=5.0, judge=1.0, hypergradient=7.0,
               hypergradient_unrolled=6.0, first_step=9.0),
        record(render=2.0, train=5.0, judge=1.0),
    ]  # fmt: skip
    found = costs([spender("ours", records, 60.0)])["ours"]
    assert found.seconds == {
        "warm start": 20.0, "first step": 9.0, "images": 12.0, "training": 10.0, "derivative": 7.0, "scores": 2.0,
        "in all": 60.0,
    }  # fmt: skip
    assert sum(found.seconds[column] for column in SECONDS[:-1]) == found.seconds["in all"]
    reading = costs([spender("label_shift", [], 9.0, shown=[{"name": "can"}])])["label_shift"].seconds
    assert (reading["warm start"], reading["first step"], reading["in all"]) == (0.0, 9.0, 9.0)


def test_runs_of_a_method_are_averaged_but_for_their_memory_which_is_the_largest():
    runs = [
        spender("ours", [record(train=s)], 2 * s, images=10 * s, peak_memory_mb=100.0 * s) for s in (1, 3)
    ]
    found = costs([*runs, spender("lts", [record(reward=1.0)], 1.0)])
    assert list(found) == ["ours", "lts"]
    assert found["ours"].seconds["training"] == 2.0 and found["ours"].images == 20.0
    assert found["ours"].memory == 300.0 and found["lts"].memory is None
    assert found["lts"].seconds["scores"] == 1.0


def test_the_error_of_gradients_is_the_median_and_leaves_out_those_that_have_none():
    records = [
        record((2.0, 0.0, 1.0), (1.0, 0.0, 0.0), train=1.0),
        record((1.0, 1.0, 4.0), (0.1, None, 3.0), train=1.0),  # None: results.json has null for infinity
    ]
    assert costs([spender("ours", records, 2.0)])["ours"].error == 0.5  # of 0.5, 0.1 and 0.75
    assert costs([spender("lts", [record(train=1.0)], 2.0)])["lts"].error is None
    older = {"seconds": {"train": 1.0}, "gradient_norms": [1.0]}
    assert costs([spender("ours", [older], 2.0)])["ours"].error is None


def test_a_table_has_a_row_for_each_method():
    head, rule, row, *_ = costs_table(
        [spender("ours", [record((2.0,), (1.0,), train=1.0)], 3.0)]
    ).splitlines()
    assert head.startswith("| cost | warm start, s |") and head.count("|") == rule.count("|") == row.count(
        "|"
    )
    assert row == "| ours | 2 | 0 | 0 | 1 | 0 | 0 | 3 |  | 30 | 0.50 |"


def test_an_object_that_no_test_image_shows_is_in_no_curve():
    """results.json has null for its score."""
    point = {"images": 9, "seconds": 2.0, "ap": {"ap": 0.5, "per_class": {"can": 0.5, "mug": None}}}
    run = finished(AP, experiment="gap", method="ours", seed=0, curve=[point])
    assert biased_ap(run, "seconds")[1].tolist() == [0.5]


def test_costs_of_unequal_numbers_of_runs_say_so():
    def spent(method, seed, seconds):
        made = run(method, seed, 0.5, (seconds,))
        return dataclasses.replace(made, results={**made.results, "iterations": []})

    runs = [spent("ours", 0, 10.0), spent("ours", 1, 30.0), spent("other", 0, 10.0)]
    text = costs_table(runs)
    assert "| ours, mean of 2 |" in text and "| other, mean of 1 |" in text
    assert "different numbers of runs" in text and "mean of" not in costs_table(runs[1:])

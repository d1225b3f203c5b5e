"""What methods cost, of runs whose seconds, images and gradients are known."""

from finished_runs import finished

from neural_sim.report.costs import SECONDS, costs, costs_table

AP = {"ns": (0.2, 0.2), "learned": (0.5, 0.5), "matched": (0.9, 0.9)}


def record(norms=(), errors=(), **seconds):
    return {"seconds": seconds, "gradient_norms": list(norms), "gradient_errors": list(errors)}


def run(method, records, seconds, images=30, **more):
    curve = [{"images": 0, "seconds": 0.0}, {"images": images, "seconds": seconds}]
    return finished(AP, experiment="gap", method=method, seed=0, iterations=records, curve=curve, **more)


def test_seconds_by_phase_add_up_to_what_the_method_is_charged():
    records = [
        record(pool=4.0, probes=1.0, render=2.0, features=3.0, train=5.0, judge=1.0, hypergradient=7.0,
               hypergradient_unrolled=6.0),
        record(render=2.0, train=5.0, judge=1.0),
    ]  # fmt: skip
    found = costs([run("ours", records, 51.0)])["ours"]
    assert found.seconds == {
        "warm start": 20.0, "images": 12.0, "training": 10.0, "derivative": 7.0, "scores": 2.0, "in all": 51.0
    }  # fmt: skip
    assert sum(found.seconds[column] for column in SECONDS[:-1]) == found.seconds["in all"]


def test_runs_of_a_method_are_averaged_but_for_their_memory_which_is_the_largest():
    runs = [run("ours", [record(train=s)], 2 * s, images=10 * s, peak_memory_mb=100.0 * s) for s in (1, 3)]
    found = costs([*runs, run("lts", [record(reward=1.0)], 1.0)])
    assert list(found) == ["ours", "lts"]
    assert found["ours"].seconds["training"] == 2.0 and found["ours"].images == 20.0
    assert found["ours"].memory == 300.0 and found["lts"].memory is None
    assert found["lts"].seconds["scores"] == 1.0


def test_the_error_of_gradients_is_the_median_and_leaves_out_those_that_have_none():
    records = [
        record((2.0, 0.0, 1.0), (1.0, 0.0, 0.0), train=1.0),
        record((1.0, 1.0, 4.0), (0.1, None, 3.0), train=1.0),
    ]
    records[1]["gradient_errors"][1] = float("inf")
    assert costs([run("ours", records, 2.0)])["ours"].error == 0.5  # of 0.5, 0.1 and 0.75
    assert costs([run("lts", [record(train=1.0)], 2.0)])["lts"].error is None
    older = {"seconds": {"train": 1.0}, "gradient_norms": [1.0]}
    assert costs([run("ours", [older], 2.0)])["ours"].error is None


def test_a_table_has_a_row_for_each_method():
    head, rule, row, *_ = costs_table([run("ours", [record((2.0,), (1.0,), train=1.0)], 3.0)]).splitlines()
    assert head.startswith("| cost | warm start, s |") and head.count("|") == rule.count("|") == row.count(
        "|"
    )
    assert row == "| ours | 2 | 0 | 1 | 0 | 0 | 3 |  | 30 | 0.50 |"

"""The table that a sweep ends with."""

import json

from neural_sim.report.sweep import sweep_table


def job(folder, name, overrides, after=None, scale="quick"):
    (folder / name / ".hydra").mkdir(parents=True)
    (folder / name / ".hydra" / "overrides.yaml").write_text(json.dumps(overrides))
    if after is None:
        return
    ap = {
        which: {"ap": 0.1, "per_class": {"mug": value, "can": None}}
        for which, value in {"ns": 0.25, "learned": after, "matched": 0.75}.items()
    }
    held = {"score": "AP", "scale": scale, "biased": ["mug", "can"], "ap": ap}
    (folder / name / "results.json").write_text(json.dumps(held))


def test_a_sweep_ends_with_what_its_runs_scored_by_what_was_swept(tmp_path):
    job(tmp_path, "10_seed=2", ["+experiment=pose_gap", "seed=2", "baseline=lts"])
    job(tmp_path, "2_seed=1", ["+experiment=pose_gap", "seed=1", "baseline=lts"], 0.5)
    job(tmp_path, "0_seed=0", ["+experiment=pose_gap", "seed=0", "baseline=lts"], 0.625)
    (tmp_path / "mlruns").mkdir()
    lines = sweep_table(tmp_path).splitlines()
    assert lines[0] == "| seed | AP before | AP after | AP if the target were known | folder |"
    assert lines[2:5] == [
        "| 0 | 25.0 | 62.5 | 75.0 | 0_seed=0 |",
        "| 1 | 25.0 | 50.0 | 75.0 | 2_seed=1 |",
        "| 2 | no results |  |  | 10_seed=2 |",
    ]
    assert lines[-1] == f"pages: {tmp_path}/<folder>/report.html"


def test_a_sweep_of_trials_says_so_and_one_result_is_no_table(tmp_path):
    job(tmp_path, "0", ["seed=0", "scale=smoke"], 0.5, "smoke")
    assert sweep_table(tmp_path) == ""
    job(tmp_path, "1", ["seed=1", "scale=smoke"], 0.5, "smoke")
    assert sweep_table(tmp_path).startswith("A trial (scale=smoke)")

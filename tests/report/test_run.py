"""What a run leaves: results.json by the standard, figures, the training set, MLflow; and the table of a sweep."""

import dataclasses
import json
import math

import pytest
import torch
from mlflow import MlflowClient

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.report import tracking
from neural_sim.report.figures import image_grid, psi_figure, strip_figure, write_figures
from neural_sim.report.run import Learned, RunResults, sweep_table, write_results
from neural_sim.report.run_tracking import live_run
from neural_sim.types import LabelledImages


@pytest.fixture
def results():
    uniform = torch.full((2, 4), 0.25, dtype=torch.float64)
    peaked = torch.tensor([[0.85, 0.05, 0.05, 0.05], [0.25] * 4], dtype=torch.float64)
    record = {
        "probabilities": {"pose": uniform.tolist()}, "entropies": {"pose": [1.0, 1.0]}, "gradient_norms": [0.1, 0.2],
        "validation_loss": 0.5, "training_loss": float("nan"), "seconds": {"render": 0.5},
        "scores": [0.4, 0.2],
        "verdicts": {"a": {"accepted": False, "expected_gain": 0.1, "measured_gain": -0.01, "error": 0.02}},
        "taken_back": {"b": {"kept": 1, "accepted": 3, "gain": 0.02}},
        "images_without_box": 3, "images": 24, "detector_steps": 6, "products": 9, "cpu_seconds": 0.4,
        "certificate": {
            "adjoint": {
                "stationarity": 1.0, "solver_status": "CONVERGED", "solver_steps": 3, "solver_residual": 0.01,
                "damping": 2.0, "curvature_min": -1.0, "curvature_max": 9.0, "condition": 11.0,
            },
            "cosine": 0.9, "doubts": [],
            "p_values": {"a": {"pose": 0.3}, "b": {"pose": 0.01}},
            "actions": {"a": {"pose": "shrunk"}, "b": {"pose": "kept"}},
        },
    }  # fmt: skip
    scores = {"ap": 0.5, "ap50": 0.7, "per_class": {"a": 0.6, "b": float("nan")}, "per_class_ap50": {}}
    return RunResults(
        "pose_gap", "neural_sim", 3, ("a", "b"), ("a",),
        {"initial": {"pose": uniform}, "learned": {"pose": peaked}, "target": {"pose": peaked}}, [record, record],
        {"ns": scores, "learned": scores, "matched": scores}, {"a": [{"psnr": 30.0, "ssim": 0.9}], "b": []},
        {"psi": 1.5}, {"peak_memory_mb": 512.0},
        [{"stage": "views", "what": "views of a", "why": "found in the store", "fraction": 1.0, "seconds": 2.0}],
        {"seed": 3, "parameter": {"pose": {"bins": 4}}}, 0.25,
    )  # fmt: skip


def test_results_are_json_by_the_standard(results, tmp_path):
    held = json.loads(write_results(results, tmp_path).read_text(), parse_constant=pytest.fail)
    assert held["ap"]["ns"]["per_class"]["b"] is None and held["validation_ap"] == 0.25
    assert held["total_variation"]["a"]["pose"] == {"initial": pytest.approx(0.6), "learned": 0.0}
    assert held["certificates"]["actions"] == {"shrunk": 2} and held["certificates"]["cosines"] == [0.9, 0.9]
    assert held["images_without_box"] == 6
    assert held["psi"]["a"]["pose"]["learned"] == pytest.approx([0.85, 0.05, 0.05, 0.05])


def test_what_the_target_shows_is_in_the_results_the_summary_and_the_history(results, tmp_path):
    one = FactorEstimate(
        "a", "pose", 40, (0.25,) * 4, (0.85, 0.05, 0.05, 0.05), (0.7, 0.0, 0.0, 0.0), (0.9, 0.1, 0.1, 0.1),
        ((1,), (2,), (3,), (4,)), 0.005, 0.05, 0.9, "moves",
    )  # fmt: skip
    read = dataclasses.replace(results, records=[], shown=(one,))
    held = json.loads(write_results(read, tmp_path).read_text())
    assert held["shown"][0]["low"] == [0.7, 0.0, 0.0, 0.0] and held["shown"][0]["finding"] == "moves"
    assert "your target shows the a in pose bin 1 (0.70 to 0.90)" in read.summary()
    assert [history[0] for history in read.learned[0].history] == [0.25, 0.85]
    # A loop that ended after its first step: its one record is of the training there.
    record = {
        **results.records[0],
        "probabilities": {"pose": results.probabilities["learned"]["pose"].tolist()},
    }
    stepped = dataclasses.replace(read, records=[record])
    assert [history[0] for history in stepped.learned[0].history] == [0.25, 0.85]
    assert read.moved and not dataclasses.replace(read, shown=()).moved


def test_bins_that_look_the_same_are_scored_as_one(results):
    one = dataclasses.replace(results, symmetric_bins={"a": {"pose": [[1, 3], [2], [4]]}})
    # p is 0.25 in each bin, the target 0.85, 0.05, 0.05, 0.05: over the groups 0.5, 0.25, 0.25 to 0.9, 0.05, 0.05.
    a, b = one.of_factor("pose")
    assert a.distances["initial"] == pytest.approx(0.4) and b == results.of_factor("pose")[1]


def test_bins_that_look_the_same_are_drawn_as_one():
    last = [0.4, 0.1, 0.4, 0.1]
    learned = Learned("a", "pose", [[1, 3], [2], [4]], {"target": last}, [[0.25] * 4, last], {})
    axes = psi_figure([learned], "title").axes[0]
    assert axes.get_title() == "a (1=3)" and [text.get_text() for text in axes.texts] == ["1=3"]
    heights = [bar.get_height() for bar in axes.patches]
    assert heights == pytest.approx([0.8, 0.1, 0.1]) and len(axes.collections) == 3


def test_nothing_is_said_of_a_target_that_nobody_knows(results, tmp_path):
    known = {which: p for which, p in results.probabilities.items() if which != "target"}
    ap = {which: scores for which, scores in results.ap.items() if which != "matched"}
    photographs = dataclasses.replace(results, probabilities=known, ap=ap)
    held = photographs.document()
    assert held["total_variation"] == {"a": {}, "b": {}} and set(held["psi"]["a"]["pose"]) == {
        "initial",
        "learned",
    }
    text = photographs.summary()
    assert "after" in text and "target" not in text
    images = LabelledImages(
        torch.rand(1, 3, 16, 16), torch.zeros(1, 1, 4), torch.tensor([[-1]]), torch.zeros(1).long()
    )
    paths = write_figures(photographs, images, images, [], tmp_path)
    assert {path.name for path in paths} == {"psi_pose.png", "ap.png", "training_images.png"}


def test_a_panel_without_a_target_has_no_bar():
    history = [[0.25] * 4, [0.4, 0.1, 0.4, 0.1]]
    (axes,) = psi_figure([Learned("a", "pose", [[1], [2], [3], [4]], {}, history, {})], "title").axes
    assert not axes.patches and len(axes.collections) == 4 and axes.get_xlim() == (0.0, 1.0)
    assert "target" not in [label.get_text() for label in axes.get_xticklabels()]


def test_summary_names_every_method_and_object(results):
    text = results.summary()
    trust = (
        "untrusted psi steps of objects: 2 of 4; shrunk 2; signal 2; trainings rejected 2 of the 2 that they judged; "
        "taken back at the end b (keeps 1 of 3 steps); "
    )
    trust += "cosine with the response of training 0.90, 0.90"
    images = ("validation images, after: 25.0", "without a box: 6")
    for word in (
        "before",
        "after",
        "distance to",
        "60.0",
        "nan",
        *images,
        trust,
    ):
        assert word in text


def test_the_summary_names_objects_that_are_not_found_unless_the_scale_says_that_scores_mean_nothing(results):
    assert "next to nothing" not in results.summary()
    name, other = results.names[:2]
    learned = {**results.ap["learned"], "per_class": {name: 0.013, other: math.nan}}
    unfound = dataclasses.replace(results, ap={**results.ap, "learned": learned})
    assert f"next to nothing is found of {name} (AP 1.3);" in unfound.summary()
    smoke = dataclasses.replace(unfound, made=dataclasses.replace(results.made, scale="smoke"))
    assert "next to nothing" not in smoke.summary()


def test_a_classification_run_says_accuracy_where_others_say_ap(results, uri, tmp_path):
    scores = {"accuracy": 0.5, "per_class": {"a": 0.6, "b": float("nan")}}
    point = {"iteration": 1, "images": 9, "seconds": 2.0, "ap": scores}
    found = dataclasses.replace(results, score="accuracy", ap={"learned": scores}, curve=[point])
    lines = found.summary().splitlines()
    assert lines[0] == "accuracy on test images"
    assert [line.split()[:2] for line in lines[2:7]] == [
        ["distance", "to"], ["after", "target"], ["a", "60.0"], ["b", "nan"], ["mean", "50.0"]
    ]  # fmt: skip
    assert "accuracy on the validation images, after: 25.0" in found.summary() and "AP" not in found.summary()
    held = json.loads(write_results(found, tmp_path / "run").read_text())
    assert held["score"] == "accuracy" and held["ap"]["learned"]["accuracy"] == 0.5
    assert json.loads(write_results(results, tmp_path / "other").read_text())["score"] == "AP"
    with live(uri, found) as run:
        run.finish(found, tmp_path / "run", "It worked.")
    (tracked,) = tracking.logged_runs(uri, "pose_gap")
    metrics = MlflowClient(uri).get_run(tracked.run_id).data.metrics
    assert metrics["evaluate/learned/accuracy"] == 0.5 and metrics["evaluate/learned/accuracy_a"] == 0.6
    assert steps(uri, tracked.run_id, "curve/biased_accuracy_by_images") == {9: 0.6}
    assert metrics["validation_accuracy"] == 0.25
    assert not any("ap" in key.replace("/", "_").split("_") for key in metrics)


def test_captions_fit_above_wide_images_of_several_objects():
    labels = torch.tensor([[0, 1, 2], [1, -1, -1], [-1, -1, -1]])
    images = LabelledImages(
        torch.rand(3, 3, 60, 80), torch.tensor([1.0, 2.0, 20.0, 30.0]).expand(3, 3, 4), labels, labels[:, 0]
    )
    figure = image_grid(images, ("a", "b", "c"))
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.texts] == ["a +2", "b", "no box"]
    assert axes.images[0].get_array().shape[:2] == (60 + 11, 3 * (80 + 11))  # no columns without an image
    width, height = figure.get_size_inches()
    assert width == 5.0 and height == pytest.approx(0.4 + 1.35 * 71 / 91)


def test_figures_are_written(results, tmp_path):
    images = LabelledImages(
        torch.rand(3, 3, 16, 16),
        torch.tensor([[[2.0, 2, 9, 9]]] * 3),
        torch.tensor([[0], [1], [-1]]),
        torch.zeros(3).long(),
    )
    nothing = {"boxes": torch.zeros(0, 4), "scores": torch.zeros(0), "labels": torch.zeros(0).long()}
    found = {
        "boxes": torch.tensor([[2.0, 2, 9, 9]]),
        "scores": torch.tensor([0.9]),
        "labels": torch.tensor([1]),
    }
    made = write_figures(results, images, images, [found, nothing, found], tmp_path, (images, images))
    names = {"psi_pose.png", "ap.png", "training_images.png", "detections.png", "strip.png"}
    assert {path.name for path in made} == names
    assert all(path.read_bytes()[:4] == b"\x89PNG" and path.stat().st_size > 5000 for path in made)


def test_the_strip_shows_each_object_before_and_after_with_its_score(results):
    def flat(colour):
        """Three images of each of both objects, all of one colour, object 1's darker."""
        images = torch.full((6, 3, 16, 16), colour)
        images[3:] *= 0.5
        labels = torch.tensor([0, 0, 0, 1, 1, 1])
        return LabelledImages(images, torch.zeros(6, 1, 4), labels[:, None], torch.zeros(6).long())

    named = dataclasses.replace(results, names=("a", "b"), biased=("b",))
    figure = strip_figure(named, flat(0.2), flat(0.4), flat(0.8))
    (axes,) = figure.axes
    canvas = axes.get_images()[0].get_array()
    starts, rows = (0, 2 * 16 + 4, 5 * 16 + 8), (3 + 8, 3 + 16 + 8)
    shown = [[float(canvas[row, start + 8, 0]) for start in starts] for row in rows]
    assert shown == [
        pytest.approx([0.1, 0.2, 0.4]),
        pytest.approx([0.2, 0.4, 0.8]),
    ]  # the biased object first
    words = [text.get_text() for text in axes.texts]
    assert words[:3] == ["the target", "rendered at first", "rendered now"]
    assert words[3:] == [
        "b: not in the\ntest images",
        "a: AP\n60 before\n60 after\n60 if the target were known",
    ]


def live(uri, results):
    config = {"name": "pose_gap", "seed": 3, **results.config}
    return live_run(uri, config, "neural_sim", results.names, results.biased)


def test_a_run_is_told_from_others_by_its_name_and_tags(results, uri):
    backbone = {"architecture": "resnet18"}
    detector = {"_target_": "neural_sim.detector.fcos.Fcos", "backbone": backbone}
    config = {"name": "pose_gap", "seed": 3, **results.config, "detector": detector}
    for scale, name in (("smoke", "lts seed 3 smoke"), ("quick", "lts seed 3")):
        with live_run(uri, config, "lts", ("a", "b"), ("b",), scale=scale):
            (found,) = (run for run in tracking.logged_runs(uri, "pose_gap") if run.status == "RUNNING")
        held = MlflowClient(uri).get_run(found.run_id)
        told = {key: held.data.tags[key] for key in ("scale", "detector", "objects", "biased")}
        assert held.info.run_name == name
        assert told == {"scale": scale, "detector": "Fcos resnet18", "objects": "a,b", "biased": "b"}


def steps(uri, run_id, key):
    return {point.step: point.value for point in MlflowClient(uri).get_metric_history(run_id, key)}


def test_a_run_lands_in_mlflow_with_metrics_by_step(results, uri, tmp_path):
    write_results(results, tmp_path / "run")
    with live(uri, results) as run:
        run.finish(results, tmp_path / "run", "It worked.")
    (found,) = tracking.logged_runs(uri, "pose_gap")
    held = MlflowClient(uri).get_run(found.run_id)
    assert held.info.status == "FINISHED" and held.data.tags["method"] == "neural_sim"
    assert held.data.tags["mlflow.note.content"].startswith("It worked.\n\n`evaluate/ns` scores the detector")
    assert held.data.params["parameter.pose.bins"] == "4" and held.info.run_name == "neural_sim seed 3"
    assert held.data.metrics["evaluate/learned/ap"] == 0.5 and held.data.metrics["validation_ap"] == 0.25
    assert "evaluate/ns/ap_b" not in held.data.metrics
    assert steps(uri, found.run_id, "psi/a/pose/bin_1") == {0: 0.25, 1: 0.25}
    assert steps(uri, found.run_id, "psi/a/pose/p_value") == {0: 0.3, 1: 0.3}
    assert steps(uri, found.run_id, "psi/a/score") == {0: 0.4, 1: 0.4}
    assert steps(uri, found.run_id, "psi/a/accepted") == {0: 0.0, 1: 0.0}
    for name, trusted in (("a", 0.0), ("b", 1.0)):
        assert steps(uri, found.run_id, f"psi/{name}/pose/trusted") == {0: trusted, 1: trusted}
    assert steps(uri, found.run_id, "field/a/psnr") == {0: 30.0}
    assert found.files == {"results.json"}


def test_iterations_and_stages_are_there_when_they_end_and_are_written_once(results, uri, tmp_path):
    first, second = ({**results.records[0], "validation_loss": loss} for loss in (0.5, 0.25))
    write_results(results, tmp_path / "run")
    with live(uri, results) as run:
        (found,) = tracking.logged_runs(uri, "pose_gap")
        assert found.status == "RUNNING"
        run.fields({"a": [{"psnr": 29.0}, {"psnr": 30.0}]})
        run.stage("field", 7.5)
        run.iteration(first)
        assert steps(uri, found.run_id, "psi/validation_loss") == {0: 0.5}
        assert steps(uri, found.run_id, "psi/seconds_render") == {0: 0.5}
        assert steps(uri, found.run_id, "seconds/field") == {0: 7.5}
        run.iterations([first, second])
        assert steps(uri, found.run_id, "psi/validation_loss") == {0: 0.5, 1: 0.25}
        run.finish(dataclasses.replace(results, records=[first, second]), tmp_path / "run", "It worked.")
    history = MlflowClient(uri).get_metric_history(found.run_id, "psi/validation_loss")
    assert [point.value for point in history] == [0.5, 0.25]
    assert steps(uri, found.run_id, "field/a/psnr") == {0: 29.0, 1: 30.0}


def test_what_was_reached_charts_by_what_was_spent(results, uri, tmp_path):
    results = dataclasses.replace(results, biased=("a", "b"))
    scores = {"ap": 0.5, "per_class": {"a": 0.6, "b": math.nan}}  # no test image shows b
    points = [
        {"iteration": i, "images": 300 * i, "seconds": 2.6 * i, "ap": scores | {"ap": 0.1 * i}}
        for i in (0, 4)
    ]
    (tmp_path / "run").mkdir()
    with live(uri, results) as run:
        run.finish(dataclasses.replace(results, curve=points), tmp_path / "run", "It worked.")
    (found,) = tracking.logged_runs(uri, "pose_gap")
    for name, expected in (
        ("ap_by_iteration", {0: 0.0, 4: 0.4}),
        ("ap_by_images", {0: 0.0, 1200: 0.4}),
        ("biased_ap_by_seconds", {0: 0.6, 10: 0.6}),
    ):
        assert steps(uri, found.run_id, f"curve/{name}") == pytest.approx(expected)


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


def test_a_sweep_leaves_empty_what_no_test_image_shows(tmp_path):
    for name in ("0", "1"):
        job(tmp_path, name, [f"seed={name}"], 0.5)
        held = json.loads((tmp_path / name / "results.json").read_text())
        (tmp_path / name / "results.json").write_text(json.dumps({**held, "biased": ["can"]}))
    assert sweep_table(tmp_path).splitlines()[2] == "| 0 |  |  |  | 0 |"


def test_a_sweep_of_trials_says_so_and_one_result_is_no_table(tmp_path):
    job(tmp_path, "0", ["seed=0", "scale=smoke"], 0.5, "smoke")
    assert sweep_table(tmp_path) == ""
    job(tmp_path, "1", ["seed=1", "scale=smoke"], 0.5, "smoke")
    assert sweep_table(tmp_path).startswith("A trial (scale=smoke)")

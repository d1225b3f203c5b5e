"""The group ``task``: what it chooses, what it refuses, and a classification through the command line."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from composing import composed
from made_photographs import photographs_by_class

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.main import UserError, build
from neural_sim.outer.objective import Loss

ROOT = Path(__file__).parents[1]


def made(*overrides):
    return build(composed(*overrides))


def _run(folder, *arguments):
    paths = [
        f"paths.store={folder}/store",
        f"paths.mlflow={folder}/mlflow.db",
        "progress=false",
        "scale=smoke",
    ]
    command = [sys.executable, "-m", "src.main", *arguments, *paths]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout


def test_a_task_chooses_detector_score_and_objective():
    chosen = {task: made(f"task={task}") for task in ("detection", "classification")}
    assert {task: x.score for task, x in chosen.items()} == {"detection": "AP", "classification": "accuracy"}
    objectives = {task: x.loop.outer.objective for task, x in chosen.items()}
    assert objectives == {"detection": SmoothAP(), "classification": SmoothAccuracy()}
    assert isinstance(chosen["classification"].detector(num_classes=2, image_size=32), Classifier)
    assert made().config == chosen["detection"].config


@pytest.mark.parametrize("baseline", ["neural_sim_paper", "auto_sim", "lts", "response"])
def test_every_kind_of_method_takes_it(baseline):
    x = made("task=classification", f"baseline={baseline}", "+experiment=pose_gap")
    assert x.score == "accuracy" and isinstance(x.loop.outer.objective, (SmoothAccuracy, Loss))


def test_the_command_line_goes_before_the_task():
    x = made("task=classification", "detector=classifier_resnet18", "outer/objective=loss")
    assert x.config["detector"]["backbone"]["architecture"] == "resnet18" and x.loop.outer.objective == Loss()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["task=classification", "detector=tiny"],
            "task=classification does not go with a detector that is scored by AP",
        ),
        (["detector=classifier"], "task=detection does not go with a detector that is scored by accuracy"),
        (
            ["task=classification", "+variant=paper"],
            "task=classification does not go with a detector that is scored by AP",
        ),
        (["outer/objective=smooth_accuracy"], "outer/objective: want smooth_ap or loss for task=detection"),
        (
            ["task=classification", "outer/objective=smooth_ap"],
            "outer/objective: want smooth_accuracy or loss for task=classification, got SmoothAP",
        ),
        (
            ["task=classification", "synthesis.objects_per_image=[1,2]"],
            r"synthesis.objects_per_image: want \[1, 1\] for task=classification, .* got \[1, 2\]",
        ),
        (
            ["task=classification", "detector.backbone.weights=DEFAULT"],
            "backbone.weights: tiny has no published",
        ),
    ],
)
def test_what_does_not_belong_together_is_refused(overrides, message):
    with pytest.raises(ValueError, match=message):
        x = made(*overrides)
        x.detector(num_classes=2, image_size=32)


def test_photographs_without_boxes_are_for_classifiers(tmp_path):
    root = photographs_by_class(tmp_path / "photos")
    with pytest.raises(ValueError, match="target: its photographs have no boxes, want task=classification"):
        made("target=folders", f"target.root={root}")
    with pytest.raises(UserError, match=r"target.root: no such folder: .*elsewhere; put photographs there"):
        made("task=classification", "target=folders", f"target.root={tmp_path / 'elsewhere'}")
    assert made("task=classification", "target=folders", f"target.root={root}").score == "accuracy"


@pytest.mark.slow
def test_a_classification_from_objects_to_a_report_and_a_comparison(tmp_path):
    """On photographs by class, with every photograph of the part train in training, and two methods compared."""
    root = photographs_by_class(tmp_path / "photos")
    words = [
        "task=classification", "+experiment=pose_gap", "objects.names=[can,pitcher,drill]", "target=folders",
        f"target.root={root}", "target.unmatched=leave_out", "target.train_fraction=0.5", "training.real.mode=combined",
        "detector.backbone.architecture=micro",
    ]  # fmt: skip
    for method in ("neural_sim", "lts"):
        printed = _run(tmp_path, *words, f"baseline={method}", f"hydra.run.dir={tmp_path / method}")
        assert re.search(r"^accuracy on the test set +can +pitcher +drill +mean$", printed, re.MULTILINE)
        results = json.loads((tmp_path / method / "results.json").read_text())
        assert results["score"] == "accuracy" and set(results["ap"]) == {
            "ns", "learned", "matched", "synthetic_only", "real_only", "views_only",
        }  # fmt: skip
        for scores in results["ap"].values():
            assert scores["accuracy"] == pytest.approx(sum(scores["per_class"].values()) / 3)
        assert len(results["curve"]) == 2 and 0.0 <= results["validation_ap"] <= 1.0
        model = json.loads((tmp_path / method / "model.json").read_text())
        assert model["detector"]["class"] == "neural_sim.detector.classifier:Classifier"
        page = (tmp_path / method / "report.html").read_text()
        assert "Accuracy on the test set" in page and not re.search(r">[^<]*\bAP\b", page)
    assert any(record["certificate"] for record in json.loads(
        (tmp_path / "neural_sim" / "results.json").read_text())["iterations"])  # fmt: skip
    _run(
        tmp_path,
        "+experiment=compare",
        "compare.experiments=[pose_gap]",
        f"hydra.run.dir={tmp_path / 'compare'}",
    )
    assert "| lts |" in (tmp_path / "compare" / "compare.md").read_text()
    photos = _run(tmp_path, "stages=[predict]", f"predict.model={tmp_path / 'lts'}", f"predict.images={root}",
                  f"hydra.run.dir={tmp_path / 'predicted'}")  # fmt: skip
    assert re.search(r"(\d+) detections in \1 pictures", photos)  # one class for each

"""Which detections are right, and the figure and files of a gallery."""

import json

import pytest
import torch
from mlflow import MlflowClient

from neural_sim.detector.metrics import AveragePrecision
from neural_sim.stages.evaluate import Scores
from neural_sim.studies.detection_gallery import (
    DetectionGallery,
    count,
    detections_figure,
    judge,
    judged,
)
from neural_sim.types import LabelledImages

TRUE = torch.tensor([[10.0, 10.0, 30.0, 30.0], [50.0, 10.0, 70.0, 30.0]])
LABELS = torch.tensor([0, 1])


def detections(*rows):
    """From (box, label, score)."""
    boxes, labels, scores = zip(*rows, strict=True) if rows else ((), (), ())
    return {
        "boxes": torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        "labels": torch.tensor(labels, dtype=torch.long),
        "scores": torch.tensor(scores, dtype=torch.float32),
    }


def verdict(*rows, above=0.3):
    return judge(detections(*rows), TRUE, LABELS, above, 0.5)


def test_a_box_of_its_class_is_right_once_and_by_its_best_detection():
    close, exact = (12.0, 10.0, 32.0, 30.0), (10.0, 10.0, 30.0, 30.0)  # an overlap of 18/22, and 1
    found = verdict((exact, 0, 0.6), (close, 0, 0.8))
    assert found.kept.tolist() == [1, 0] and found.right.tolist() == [True, False]
    assert found.missed.tolist() == [False, True]


@pytest.mark.parametrize(
    ("box", "label", "score", "kept", "right"),
    [
        ((50.0, 10.0, 70.0, 30.0), 1, 0.9, 1, 1),
        ((50.0, 10.0, 70.0, 30.0), 0, 0.9, 1, 0),  # another class
        ((50.0, 10.0, 70.0, 30.0), 1, 0.2, 0, 0),  # below the score
        ((50.0, 10.0, 60.5, 30.0), 1, 0.9, 1, 1),  # an overlap of 10.5 / 20
        ((50.0, 10.0, 59.5, 30.0), 1, 0.9, 1, 0),  # of 9.5 / 20
    ],
)
def test_class_score_and_overlap_decide(box, label, score, kept, right):
    found = verdict((box, label, score))
    assert (len(found.kept), int(found.right.sum())) == (kept, right)
    assert int(found.missed.sum()) == 2 - right


def gallery():
    images = torch.rand(3, 3, 40, 80, generator=torch.Generator().manual_seed(0))
    boxes, labels = TRUE.expand(3, 2, 4).clone(), LABELS.expand(3, 2).clone()
    labels[2, 1] = -1  # padding
    test = LabelledImages(images, boxes, labels, torch.zeros(3, dtype=torch.long))
    hit, wrong = ((10.0, 10.0, 30.0, 30.0), 0, 0.9), ((0.0, 0.0, 9.0, 9.0), 1, 0.5)
    return test, {
        "ns": [detections(wrong)] * 3,
        "neural_sim": [detections(hit, wrong), detections(hit), detections()],
    }


def test_counts_are_over_all_images_and_padding_is_no_box():
    test, found = gallery()
    counts = {method: count(judged(every, test, 0.3, 0.5)) for method, every in found.items()}
    assert counts == {
        "ns": {"right": 0, "wrong": 3, "missed": 5}, "neural_sim": {"right": 2, "wrong": 1, "missed": 3}
    }  # fmt: skip


@pytest.mark.parametrize("box", [(0.0, 10.0, 9.0, 30.0), (71.0, 10.0, 80.0, 30.0), (60.0, 1.0, 80.0, 30.0)])
def test_a_caption_stays_in_its_image(box):
    test, _ = gallery()
    found = {"ns": [detections((box, 0, 0.9))] * 3}
    verdicts = {"ns": judged(found["ns"], test, 0.3, 0.5)}
    figure = detections_figure(test, found, verdicts, ["006_mustard_bottle", "mug"], torch.tensor([0]))
    figure.canvas.draw()
    axes = figure.axes[0]
    (caption,) = (text for text in axes.texts if "0.90" in text.get_text())
    image, words = axes.get_window_extent(), caption.get_window_extent()
    assert image.x0 - 1 <= words.x0 and words.x1 <= image.x1 + 1
    assert image.y0 - 1 <= words.y0 and words.y1 <= image.y1 + 1


def test_the_files_and_the_run_have_every_method(context):
    test, found = gallery()
    ap = AveragePrecision(0.25, 0.5, {"can": 0.5, "mug": 0.0}, {"can": 1.0, "mug": 0.0})
    found = {method: Scores(ap, every) for method, every in found.items()}
    run = DetectionGallery(count=2).publish(context, test, found, ["can", "mug"])
    document = json.loads((context.folder / "detection_gallery.json").read_text())
    assert document["methods"]["neural_sim"] == {"right": 2, "wrong": 1, "missed": 3, "ap": 0.25, "ap50": 0.5}
    assert document["shown"] == [0, 2]
    assert "| ns | 0 | 3 | 5 | 25.0 | 50.0 |" in (context.folder / "detection_gallery.md").read_text()
    assert (context.folder / "figures" / "detections.png").stat().st_size > 5000
    assert MlflowClient(context.uri).get_run(run.run_id).data.metrics["ns/wrong"] == 3.0

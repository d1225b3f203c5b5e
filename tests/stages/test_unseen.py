"""What cannot be learned or scored is said where it shows: classes without a box, scores that tell nothing."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from neural_sim.stages import detector as stages
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.target_sets import TargetSets, TargetSetsStage
from neural_sim.types import LabelledImages

NAMES = ("can", "mug")


def _images(*labels):
    count = len(labels)
    boxes = torch.tensor([[[1.0, 1.0, 5.0, 5.0]]] * count)
    return LabelledImages(
        torch.zeros(count, 3, 8, 8), boxes, torch.tensor(labels)[:, None], torch.full((count,), -1)
    )


@pytest.mark.parametrize(("labels", "unseen"), [((0, 0), "mug"), ((-1, -1), "can, mug"), ((0, 1), None)])
def test_a_class_that_no_test_image_shows_is_named(labels, unseen, caplog):
    stage = cast(Any, SimpleNamespace(objects=SimpleNamespace(names=NAMES)))
    sets = TargetSets(_images(0, 1), _images(*labels))
    assert len(TargetSetsStage.unpack(stage, TargetSetsStage.pack(stage, sets)).test) == 2
    said = [record.getMessage() for record in caplog.records]
    assert [line.partition(":")[2].partition(":")[0] for line in said] == (
        [f" no test image shows {unseen}"] if unseen else []
    )


def test_a_class_that_no_training_image_shows_is_named(caplog, monkeypatch):
    class Trained(Exception):
        pass

    def train(*_, **__):
        raise Trained

    monkeypatch.setattr(stages, "train_detector", train)
    stage = SimpleNamespace(
        scene=None, build=lambda: SimpleNamespace(init=lambda _: {}), training=SimpleNamespace(of=lambda _: None),
        generator=lambda: None, images=lambda *_: SimpleNamespace(images=_images(1, -1, 1)), device=torch.device("cpu"),
        names=NAMES, photographs=lambda _: None, title="detector trained on psi", epochs=1,
    )  # fmt: skip
    with pytest.raises(Trained):
        DetectorStage.make(cast(Any, stage), cast(Any, lambda _: None))
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(
        "detector trained on psi: no drawn image shows can, which it therefore cannot learn: want shorter distances"
    )


def test_scores_that_tell_nothing_say_so_whenever_they_are_read(caplog):
    stage = cast(Any, SimpleNamespace(title="test scores of the detector trained on psi"))
    nothing = {
        "boxes": torch.zeros(0, 4),
        "scores": torch.zeros(0),
        "labels": torch.zeros(0, dtype=torch.long),
    }
    classes = dict.fromkeys(NAMES, 0.0)
    score = {"ap": 0.0, "ap50": 0.0, "per_class": classes, "per_class_ap50": classes}
    ScoresStage.unpack(stage, {"ap": score, "detections": [nothing]})
    ScoresStage.unpack(
        stage, {"ap": {**score, "per_class": {**classes, "can": 0.1}}, "detections": [nothing]}
    )
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith(
        "test scores of the detector trained on psi: it is 0 for every class: it detects nothing"
    )

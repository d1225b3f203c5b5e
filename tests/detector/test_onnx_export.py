"""ONNX against torch: all anchors on 50 images, detections with the suppression inside, and what is refused."""

import dataclasses
import functools
import importlib.util
import json
import math

import pytest
import torch

from neural_sim import extras
from neural_sim.detector.fcos import Fcos
from neural_sim.detector.onnx_export import TOLERANCE, Decoded, export, largest_difference
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.detector.settings import Detections

pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

SIZE = (48, 64)


def saved(make, noise=0.2):
    generator = torch.Generator().manual_seed(4)
    detector = make(num_classes=3, image_size=SIZE)
    params = {
        name: value + noise * torch.randn(value.shape, generator=generator)
        for name, value in detector.init(generator).items()
    }
    return SavedDetector(make, params, ("can", "mug", "pitcher"), SIZE)


def images(count):
    return torch.rand(count, 3, *SIZE, generator=torch.Generator().manual_seed(5))


def run(path, given):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    outputs = session.run(None, {"images": given.numpy()})
    return {name: torch.from_numpy(value) for name, value in zip(names, outputs, strict=True)}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    held = saved(RetinaNet)
    return held, export(held, tmp_path_factory.mktemp("onnx") / "deep" / "model.onnx")


def test_onnxruntime_agrees_with_torch_on_50_images(plain):
    held, path = plain
    given = images(50)
    found = run(path, given)
    boxes, scores = Decoded(held)(given)
    assert found["boxes"].shape == boxes.shape == (50, len(held.detector.anchors), 4)
    assert found["scores"].shape == scores.shape == (50, len(held.detector.anchors), 3)
    assert (found["scores"] - scores).abs().max() <= 1e-4
    assert (found["boxes"] - boxes).abs().max() <= 1e-4 * max(SIZE)
    assert (
        scores.std() > 0.05 and (boxes[..., 2:] - boxes[..., :2]).std() > 1.0
    )  # there is something to agree on
    assert 0.0 < largest_difference(held, path, given) <= TOLERANCE


def test_outputs_that_are_not_numbers_are_no_agreement(plain):
    held, path = plain
    bias = "head.classification_head.cls_logits.bias"
    broken = {**held.params, bias: torch.full_like(held.params[bias], torch.nan)}
    assert math.isnan(largest_difference(dataclasses.replace(held, params=broken), path, images(2)))


def test_decoded_boxes_are_those_of_the_detections(plain):
    held, _ = plain
    boxes, scores = (out[0] for out in Decoded(held)(images(1)))
    (found,) = held.detector.predict(held.params, images(1))
    assert len(found["scores"])
    for box, score, label in zip(found["boxes"], found["scores"], found["labels"], strict=True):
        anchor = (scores[:, label] - score).abs().argmin()
        torch.testing.assert_close(boxes[anchor], box)
        torch.testing.assert_close(scores[anchor, label], score)


def test_any_number_of_images_and_the_class_names_in_the_file(plain):
    import onnx

    held, path = plain
    assert [len(run(path, images(count))["boxes"]) for count in (1, 3)] == [1, 3]
    props = {prop.key: prop.value for prop in onnx.load(path).metadata_props}
    assert json.loads(props["class_names"]) == list(held.class_names)
    assert not list(path.parent.glob(".*"))


@pytest.mark.parametrize(
    ("kind", "limit", "candidates"),
    [
        pytest.param(RetinaNet, 8, 1000, marks=pytest.mark.slow),
        pytest.param(RetinaNet, 100, 6, marks=pytest.mark.slow),
        (Fcos, 8, 1000),
    ],
)
def test_with_the_suppression_inside_it_gives_what_predict_gives(kind, limit, candidates, tmp_path):
    """Once the limit of an image cuts, once the candidates of a level do; the threshold and the overlap always."""
    settings = Detections(score_threshold=0.1, nms_iou=0.4, limit=limit, candidates=candidates)
    held = saved(functools.partial(kind, detections=settings))
    path = export(held, tmp_path / "model.onnx", nms=True)
    given = images(6)
    given[2] = 0.0
    found, wanted = run(path, given), held.detector.predict(held.params, given)
    assert list(found) == ["image", "boxes", "scores", "labels"]
    assert found["image"].tolist() == sorted(found["image"].tolist())
    for number, image in enumerate(wanted):
        own = {key: found[key][found["image"] == number] for key in image}
        assert len(image["scores"]) > 0 and own["labels"].tolist() == image["labels"].tolist()
        torch.testing.assert_close(own["scores"], image["scores"], atol=1e-4, rtol=0)
        torch.testing.assert_close(own["boxes"], image["boxes"], atol=1e-4 * max(SIZE), rtol=0)
    uncut = kind(3, SIZE, detections=Detections(0.1, 0.4)).predict(held.params, given)
    assert all(len(few["scores"]) < len(all_["scores"]) for few, all_ in zip(wanted, uncut, strict=True))
    assert all(len(few["scores"]) <= min(limit, 2 * candidates) for few in wanted)


def test_without_detections_the_outputs_are_empty(tmp_path):
    held = saved(RetinaNet)
    held.params["head.classification_head.cls_logits.bias"] -= 50.0
    found = run(export(held, tmp_path / "model.onnx", nms=True), images(2))
    assert {key: tuple(value.shape) for key, value in found.items()} == {
        "image": (0,), "boxes": (0, 4), "scores": (0,), "labels": (0,),
    }  # fmt: skip


def test_a_missing_package_is_one_line(monkeypatch, tmp_path):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else found(name)
    )
    with pytest.raises(
        ValueError, match=r"^model\.onnx: onnxruntime not installed; pip install 'neural-sim\[onnx\]'$"
    ):
        export(saved(RetinaNet), tmp_path / "model.onnx")

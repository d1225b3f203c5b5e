"""Model files: a round trip to the bit, detectors from outside the package, refusals; detections in photographs."""

import dataclasses
import functools
import json
import os
import stat
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from neural_sim.detector import network
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.saved_detector import DOCUMENT, WEIGHTS, SavedDetector, _sha256, detect
from neural_sim.detector.settings import Backbone
from neural_sim.target.photographs import letterbox
from neural_sim.types import PinholeCamera

NAMES = ("can", "mug", "pitcher")
OUTSIDE = Path(__file__).parents[1] / "outside"


def saved(tools, generator, make=None, **changes):
    make = make or tools.configured("micro")
    detector = make(num_classes=len(NAMES), image_size=(32, 48))
    params = {
        name: value + 0.5 * torch.randn(value.shape, generator=generator)
        for name, value in detector.init(generator).items()
    }
    return dataclasses.replace(SavedDetector(make, params, NAMES, (32, 48)), **changes)


def images(generator, count=3):
    return torch.rand(count, 3, 32, 48, generator=generator)


@pytest.mark.parametrize("choice", ["micro", "tiny", "resnet18"])
def test_a_round_trip_is_exact_to_the_bit(choice, tools, generator, tmp_path):
    camera = PinholeCamera(48, 32, 0.7, 1.1, (23.5, 16.25))
    before = saved(tools, generator, tools.configured(choice), camera=camera)
    after = SavedDetector.load(before.save(tmp_path / "run"))
    assert (after.class_names, after.image_size, after.camera) == (NAMES, (32, 48), camera)
    assert after.params.keys() == before.params.keys()
    for name, value in before.params.items():
        assert value.dtype == after.params[name].dtype
        assert torch.equal(value.view(torch.uint8), after.params[name].view(torch.uint8)), name
    pictures = images(generator)
    for ours, theirs in zip(
        before.detector.predict(before.params, pictures), after.detector.predict(after.params, pictures),
        strict=True,
    ):  # fmt: skip
        assert len(ours["scores"]) > 0 and all(torch.equal(ours[key], theirs[key]) for key in ours)
    again = SavedDetector.load(after.save(tmp_path / "again"))
    assert (tmp_path / "run" / DOCUMENT).read_text() == (tmp_path / "again" / DOCUMENT).read_text()
    assert all(torch.equal(again.params[name], value) for name, value in before.params.items())


def test_settings_of_the_constructor_survive(tools, generator, tmp_path):
    make = functools.partial(tools.configured("micro"), activation="relu")
    after = SavedDetector.load(saved(tools, generator, make).save(tmp_path)).detector
    before = make(num_classes=3, image_size=(32, 48))
    assert torch.equal(after.anchors, before.anchors) and after.detections == before.detections
    assert after._losses == before._losses and "ReLU" in str(after._predictor)
    held = json.loads((tmp_path / DOCUMENT).read_text())["detector"]["settings"]
    assert held["detections"] == {"score_threshold": 0.05, "nms_iou": 0.5, "limit": 100, "candidates": 1000}
    assert held["activation"] == "relu" and held["proximal"] == 0.0


def test_pretrained_weights_are_not_read_again(tools, generator, tmp_path, monkeypatch):
    """A backbone with weights has another shape (frozen batch normalisation); the file alone must do for it."""
    weights = tmp_path / "resnet.pt"
    torch.save(network.resnet.resnet18().state_dict(), weights)
    make = functools.partial(RetinaNet, backbone=Backbone("resnet18", str(weights), freeze=True))
    detector = make(num_classes=3, image_size=(32, 48))
    before = SavedDetector(make, detector.init(generator), NAMES, (32, 48))
    before.save(tmp_path)
    weights.unlink()
    monkeypatch.setattr(network, "load_weights", pytest.fail)
    after = SavedDetector.load(tmp_path)
    assert any("running_mean" in name for name in after.params)
    pictures = images(generator)
    ours, theirs = (one.detector.predict(one.params, pictures)[0] for one in (before, after))
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    with pytest.raises(ValueError, match=r"detector\.backbone\.weights: 'saved' is for detectors"):
        after.detector.init(generator)


def test_a_detector_from_outside_the_package_is_saved_and_found_again(generator, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(OUTSIDE)
    import my_detector

    make = functools.partial(my_detector.Cells, cell=16)
    params = make(num_classes=3, image_size=(32, 48)).init(generator)
    SavedDetector(make, params, NAMES, (32, 48)).save(tmp_path)
    after = SavedDetector.load(tmp_path / WEIGHTS)
    assert type(after.detector).__name__ == "Cells" and len(after.detector.anchors) == 6
    sys.modules.pop("my_detector")
    with pytest.raises(
        ValueError, match=r"detector\.class: my_detector:Cells .* add detector\._target_=my_detector\.Cells$"
    ):
        SavedDetector.load(tmp_path)
    assert "my_detector" not in sys.modules  # a file alone runs no code
    assert type(SavedDetector.load(tmp_path, "my_detector.Cells").detector).__name__ == "Cells"
    monkeypatch.undo()
    sys.modules.pop("my_detector")
    with pytest.raises(
        ValueError, match=r"detector\.class: my_detector:Cells cannot be imported .*PYTHONPATH"
    ):
        SavedDetector.load(tmp_path, "my_detector.Cells")


def test_settings_that_json_has_not_are_refused_when_saving(tools, generator, tmp_path):
    make = functools.partial(tools.configured("micro"), proximal=torch.tensor(0.0))
    with pytest.raises(ValueError, match=r"detector\.proximal: want a number.*tensor\(0\.\)"):
        saved(tools, generator, make).save(tmp_path)


@pytest.fixture
def folder(tools, generator, tmp_path):
    saved(tools, generator, camera=PinholeCamera(48, 32, 0.7)).save(tmp_path)
    return tmp_path


def change(folder, *keys, to):
    document = json.loads((folder / DOCUMENT).read_text())
    node = document
    for key in keys[:-1]:
        node = node[key]
    node[keys[-1]] = to
    (folder / DOCUMENT).write_text(json.dumps(document))


CHANGES = [
    (("format",), "other", r"model\.json: format: want 'neural-sim detector'"),
    (("version",), 2, r"model\.json: version: want 1, got 2"),
    (("class_names",), ["can", "can"], r"class_names: want a list of different names"),
    (("class_names",), ["can", "mug"], r"model\.safetensors: head\.\S+: want shape \[.*\], got \["),
    (("image", "height"), "32", r"image\.height: want a whole number of at least 1, got '32'"),
    (("image", "range"), [0, 255], r"image\.range: want \[0\.0, 1\.0\], got \[0, 255\]"),
    (("image", "normalisation", "mean"), [0, 0, 0], r"image\.normalisation: want .*0\.485.* got .*\[0, 0, 0\]"),
    (("detector", "class"), "subprocess:Popen", r"detector\.class: subprocess:Popen is not a detector"),
    (("detector", "class"), "antigravity:x",
     r"antigravity:x is not a detector of this package, and reading it runs code"),
    (("detector", "class"), "nowhere", r"detector\.class: want 'module:class', got 'nowhere'"),
    (("detector", "settings"), None, r"detector\.settings: want a mapping .* got None"),
    (("detector", "settings", "depth"), 3, r"detector\.settings\.depth: unknown key, want one of backbone, head"),
    (("detector", "settings", "head", "depth"), 3, r"detector\.settings\.head\.depth: unknown key, want one of chan"),
    (("detector", "settings", "head", "convs"), 9, r"model\.json: .*\.head: Head\.convs: want at least 1 and at most"),
    (("detector", "settings", "head", "convs"), 2, r"model\.safetensors: lacks head\.\S+, which the detector has"),
    (("detector", "settings", "head"), 3, r"detector\.settings\.head: want a mapping of Head's arguments, got 3"),
    (("detector", "settings", "activation"), "tanh", r"model\.json: RetinaNet\.activation: want one of"),
    (("camera", "field_of_view"), 9.0, r"camera: camera: field_of_view must lie in \(0, pi\)"),
    (("camera", "lens"), 1, r"camera: .*lens"),
    (("weights", "sha256"), "0", r"is not the file that .*model\.json describes"),
    (("weights",), None, r"model\.json: weights: want a mapping, got None"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "message"), CHANGES, ids=lambda held: str(held)[:40])
def test_a_document_is_refused_with_file_and_key(keys, value, message, folder):
    change(folder, *keys, to=value)
    with pytest.raises(ValueError, match=message) as caught:
        SavedDetector.load(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_parameters_of_which_one_bit_has_flipped_are_refused(folder):
    content = bytearray((folder / WEIGHTS).read_bytes())
    content[-5] ^= 1
    (folder / WEIGHTS).write_bytes(content)
    with pytest.raises(
        ValueError, match=r"is not the file that .*model\.json describes \(weights\.sha256 differs"
    ):
        SavedDetector.load(folder)


def test_both_files_have_the_permissions_of_new_files(folder, tmp_path):
    saved, before = SavedDetector.load(folder), os.umask(0o027)
    try:
        saved.save(tmp_path / "saved")
    finally:
        os.umask(before)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "saved").iterdir()}
    assert modes == {WEIGHTS: 0o640, DOCUMENT: 0o640}


def test_files_that_are_missing_or_broken_are_refused(folder, tmp_path):
    with pytest.raises(ValueError, match=r"want a run's folder, .*nowhere, which does not exist"):
        SavedDetector.load(tmp_path / "nowhere")
    (folder / "photo.png").touch()
    with pytest.raises(
        ValueError, match=r"want a run's folder, its model\.safetensors or model\.json, got .*photo"
    ):
        SavedDetector.load(folder / "photo.png")
    (folder / WEIGHTS).write_bytes(b"no tensors")
    change(folder, "weights", "sha256", to=_sha256(folder / WEIGHTS))
    with pytest.raises(ValueError, match=r"model\.safetensors: not readable as safetensors"):
        SavedDetector.load(folder)
    (folder / WEIGHTS).unlink()
    with pytest.raises(ValueError, match=r"has no model\.safetensors; a run writes it with stages="):
        SavedDetector.load(folder)
    (folder / DOCUMENT).write_text("{")
    (folder / WEIGHTS).touch()
    with pytest.raises(ValueError, match=r"model\.json: not readable as JSON"):
        SavedDetector.load(folder)
    (folder / DOCUMENT).unlink()
    with pytest.raises(ValueError, match=r"has no model\.json"):
        SavedDetector.load(folder)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda params: params | {"more": torch.ones(2)}, "has more, which the detector does not have"),
        (
            lambda params: params | {(name := next(iter(params))): params[name] * torch.nan},
            "want finite values",
        ),
    ],
)
def test_parameters_that_do_not_fit_are_refused_by_name(edit, message, folder):
    save_file(edit(load_file(folder / WEIGHTS)), folder / WEIGHTS)
    change(folder, "weights", "sha256", to=_sha256(folder / WEIGHTS))
    with pytest.raises(ValueError, match=message) as caught:
        SavedDetector.load(folder)
    assert str(folder / WEIGHTS) in str(caught.value)


class Bright:
    """Finds the box of the pixels above 0.9, and one in the border's corner."""

    def __init__(self, num_classes, image_size):
        self.image_size = image_size

    def predict(self, params, images, batch_size=64):
        found = []
        for image in images:
            assert image.shape == (3, *self.image_size)
            rows, columns = (torch.where((image.mean(0) > 0.9).any(axis))[0] for axis in (1, 0))
            box = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
            boxes = torch.tensor([[float(side) for side in box], [0.0, 0.0, 3.0, 3.0]])
            found.append({"boxes": boxes, "scores": torch.tensor([0.9, 0.8]), "labels": torch.tensor([0, 0])})
        return found


def test_boxes_come_back_in_the_photographs_pixels():
    """Wide, tall, large and small photographs with a white box on black; one detection lies in the border alone."""
    saved = SavedDetector(Bright, {}, ("box",), (64, 96))
    for size, box in (
        ((960, 320), (300, 80, 600, 160)),
        ((40, 160), (8, 40, 24, 120)),
        ((24, 8), (6, 2, 12, 4)),
    ):
        photo = Image.new("RGB", size)
        photo.paste((255, 255, 255), box)
        (found,) = detect(saved, [photo])
        scale = min(64 / size[1], 96 / size[0])
        assert found["scores"].tolist() == torch.tensor([0.9]).tolist()
        # A pixel of the detector's; where it is smaller than the photograph's, enlarging blurs by half of that.
        assert (found["boxes"][0] - torch.tensor(box)).abs().max() <= max(1.0 / scale, 0.5)


def test_the_inverse_of_the_letterbox_is_exact_inside_and_clips_outside(generator):
    for width, height in ((640, 480), (333, 1000), (7, 5)):
        _, placing = letterbox(Image.new("RGB", (width, height)), 96, 128)
        corner = torch.rand(50, 2, generator=generator, dtype=torch.float64)
        size = torch.tensor([width, height], dtype=torch.float64)
        boxes = torch.cat(
            [corner, corner + (1 - corner) * torch.rand(50, 2, generator=generator)], -1
        ) * size.repeat(2)
        torch.testing.assert_close(placing.of_photo(placing.boxes(boxes)), boxes, rtol=1e-12, atol=1e-9)
        outside = placing.of_photo(torch.tensor([[-50.0, -50.0, 500.0, 500.0]]))
        assert outside.tolist() == [[0.0, 0.0, float(width), float(height)]]


def test_no_photographs_give_no_detections():
    assert detect(SavedDetector(Bright, {}, ("box",), (8, 8)), []) == []

"""``stages=[predict]``: from a model file and pictures alone to drawn boxes, COCO results and scores."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from colour_detector import ColourDetector
from composing import composed
from faster_coco_eval import COCO, COCOeval_faster
from PIL import Image, ImageColor

from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.main import UserError, context_of
from neural_sim.report.figures import CLASS_COLOURS
from neural_sim.tasks.walk import walk

ROOT = Path(__file__).parents[2]
RED, GREEN = (255, 0, 0), (0, 255, 0)
SIZES = {"a.png": (120, 90), "deep/b.png": (60, 200), "deep/c.jpg": (300, 300), "d.webp": (128, 64)}
CATEGORIES = [{"id": 70, "name": "stop"}, {"id": 9, "name": "go"}, {"id": 4, "name": "tree"}]
NAMED = "predict.categories={stop: red, go: green, tree: null}"


def blocks(name):
    """Boxes of a red and a green block in whole pixels of the picture."""
    width, height = SIZES[name]
    red = (width // 10, height // 10, width // 10 + width // 4, height // 10 + height // 3)
    green = (width // 2, height // 2, width // 2 + width // 4, height // 2 + height // 4)
    return {RED: red, GREEN: green}


@pytest.fixture
def photos(tmp_path):
    root = tmp_path / "photos"
    (root / "deep").mkdir(parents=True)
    for name, size in SIZES.items():
        picture = Image.new("RGB", size, (40, 40, 60))
        for colour, box in blocks(name).items():
            picture.paste(colour, box)
        picture.save(root / name, **({"quality": 95} if name.endswith("jpg") else {}))
    (root / "notes.txt").write_text("no picture")
    return root


@pytest.fixture
def model(tmp_path):
    folder = tmp_path / "trained"
    make = functools.partial(ColourDetector)
    SavedDetector(make, make(2, (96, 128)).init(torch.Generator()), ("red", "green"), (96, 128)).save(folder)
    return folder


def annotated(folder, **changes):
    """A COCO file of all pictures but the last; its boxes are the blocks', with a tree and a crowd beside them."""
    images, annotations = [], []
    for number, name in enumerate(list(SIZES)[:3]):
        width, height = SIZES[name]
        images.append({"id": 100 + number, "file_name": name, "width": width, "height": height})
        for category, box in ((70, blocks(name)[RED]), (9, blocks(name)[GREEN]), (4, (1, 1, 9, 9))):
            bbox = [box[0], box[1], box[2] - box[0], box[3] - box[1]]
            annotations.append({"id": len(annotations) + 1, "image_id": 100 + number, "category_id": category,
                                "bbox": bbox, "area": bbox[2] * bbox[3], "iscrowd": 0})  # fmt: skip
    document = {"images": images, "annotations": annotations, "categories": CATEGORIES, **changes}
    path = folder / "labels.json"
    path.write_text(json.dumps(document))
    return path


def predict(folder, *overrides):
    config = composed("stages=[predict]", "progress=false", *overrides)
    context, others = context_of(config, folder)
    walk(context, others)
    assert "experiment" not in vars(context) and "results" not in vars(context)  # nothing of a run was built
    return folder


def held(folder, name):
    return json.loads((folder / f"coco_{name}.json").read_text())


def test_every_picture_is_drawn_and_has_results_in_its_own_pixels(photos, model, tmp_path):
    out = predict(tmp_path / "out", f"predict.model={model}", f"predict.images={photos}")
    entries = {entry["file_name"]: entry for entry in held(out, "images")["images"]}
    assert {name: (entry["width"], entry["height"]) for name, entry in entries.items()} == SIZES
    assert held(out, "images")["categories"] == [{"id": 1, "name": "red"}, {"id": 2, "name": "green"}]
    rows = held(out, "results")
    assert len(rows) == 2 * len(SIZES)
    for name, entry in entries.items():
        pixel = max(SIZES[name][0] / 128, SIZES[name][1] / 96, 0.5)  # of the detector's, in the picture's
        own = {row["category_id"]: row for row in rows if row["image_id"] == entry["id"]}
        red, green = blocks(name)[RED], blocks(name)[GREEN]
        left = green[0] + 0.27 * (green[2] - green[0])
        for row, box in ((own[1], red), (own[2], (left, green[1], left + green[2] - green[0], green[3]))):
            x, y, width, height = row["bbox"]
            assert (
                max(abs(a - b) for a, b in zip((x, y, x + width, y + height), box, strict=True))
                <= 1.5 * pixel
            )
            assert row["score"] == pytest.approx({1: 0.9, 2: 0.8}[row["category_id"]])
        before, after = (Image.open(folder / name).convert("RGB") for folder in (photos, out / "pictures"))
        assert before.size == after.size
        corner = tuple(side - 1 for side in SIZES[name])  # outside of all boxes and captions
        assert (
            max(abs(a - b) for a, b in zip(before.getpixel(corner), after.getpixel(corner), strict=True)) < 20
        )
        if name.endswith("png"):
            lines = {
                after.getpixel((x, y)) for x in range(red[0], red[2]) for y in range(red[3] - 3, red[3] + 2)
            }
            assert ImageColor.getrgb(CLASS_COLOURS[0]) in lines
    assert not (out / "scores.json").exists()


def test_low_scores_are_in_the_results_and_not_drawn(photos, model, tmp_path):
    out = predict(
        tmp_path / "out", f"predict.model={model / 'model.safetensors'}", f"predict.images={photos}/a.png",
        "predict.draw_above=0.95",
    )  # fmt: skip
    assert len(held(out, "results")) == 2
    drawn = Image.open(out / "pictures" / "a.png")
    assert drawn.tobytes() == Image.open(photos / "a.png").tobytes()


def test_scores_are_those_of_coco_on_the_written_files(photos, model, tmp_path, capsys):
    """Ids of images and categories are the annotations'; pictures without an entry are drawn alone."""
    path = annotated(photos)
    out = predict(
        tmp_path / "out", f"predict.model={model}", f"predict.images={photos}/**/*.png", f"predict.annotations={path}",
        NAMED,
    )  # fmt: skip
    rows = held(out, "results")
    assert {row["image_id"] for row in rows} == {100, 101} and {row["category_id"] for row in rows} == {70, 9}
    out = predict(
        tmp_path / "all", f"predict.model={model}", f"predict.images={photos}", f"predict.annotations={path}", NAMED,
        "predict.batch_size=2",
    )  # fmt: skip
    assert {row["image_id"] for row in held(out, "results")} == {100, 101, 102}
    assert {path.name for path in (out / "pictures").rglob("*.*")} == {Path(name).name for name in SIZES}
    scores = json.loads((out / "scores.json").read_text())
    truth = COCO(str(path))
    wanted = COCOeval_faster(truth, truth.loadRes(str(out / "coco_results.json")), "bbox")
    wanted.evaluate()
    wanted.accumulate()
    precision = torch.tensor(wanted.eval["precision"])[:, :, :, 0, -1]  # [overlaps, recalls, categories]
    for name, category in (("red", 70), ("green", 9)):
        own = precision[:, :, wanted.params.catIds.index(category)]
        assert scores["per_class"][name] == pytest.approx(float(own.mean()), rel=2**-23)  # float32
        assert scores["per_class_ap50"][name] == pytest.approx(float(own[0].mean()), rel=2**-23)  # float32
    assert scores["images"] == 3 and scores["per_class"]["red"] > 0.8
    assert scores["per_class_ap50"]["green"] == pytest.approx(1.0)  # IoU 0.57
    assert 0.1 <= scores["per_class"]["green"] <= 0.4
    assert scores["ap"] == pytest.approx((scores["per_class"]["red"] + scores["per_class"]["green"]) / 2)
    printed = capsys.readouterr().out
    assert "AP on 3 pictures" in printed and f"{100 * scores['per_class']['green']:.1f}" in printed


def test_crowds_and_classes_without_a_box_stay_out(photos, model, tmp_path, caplog):
    box = {"id": 1, "image_id": 100, "category_id": 70, "bbox": list(blocks("a.png")[RED]), "iscrowd": 0}
    box["bbox"][2:] = [120 // 4, 90 // 3]
    crowd = {**box, "id": 2, "bbox": [0, 0, 120, 90], "iscrowd": 1}
    path = annotated(photos, annotations=[box, crowd])
    out = predict(
        tmp_path / "out",
        f"predict.model={model}",
        f"predict.images={photos}/a.png",
        f"predict.annotations={path}",
        NAMED,
    )
    scores = json.loads((out / "scores.json").read_text())
    assert scores["per_class"]["green"] is None and scores["ap"] == scores["per_class"]["red"] > 0.8
    assert (
        "1 crowds are left out" in caplog.text and "2 of its images are not among the pictures" in caplog.text
    )


def broken(photos):
    (photos / "deep" / "broken.png").write_bytes((photos / "a.png").read_bytes()[:90])


def empty(photos):
    (photos.parent / "empty").mkdir()


REFUSED = [
    (None, ["predict.images=null"], r"predict\.images: want a picture, a folder or a pattern in quotes, got None"),
    (None, ["predict.images={photos}/none"], r"predict\.images: want a folder .*none, which does not exist"),
    (None, ["predict.images={photos}/*.gif"], r"predict\.images: want a folder .*\*\.gif, which no file matches"),
    (empty, ["predict.images={photos}/../empty"], r"predict\.images: no picture \(\.jpg, .* in .*empty"),
    (broken, [], r"predict\.images: .*broken\.png: not a readable image"),
    (None, ["predict.images={photos}/notes.txt"], r"predict\.images: .*notes\.txt: not a readable image"),
    (None, ["predict.model=null"], r"predict\.model: want a run's folder or its model\.safetensors, got null"),
    (None, ["predict.model={photos}"], r"predict\.model: .*photos has no model\.json"),
    (None, ["predict.draw_above=2.0"], r"predict\.draw_above: want at least 0 and at most 1, got 2\.0"),
    (None, ["predict.batch_size=0"], r"predict\.batch_size: want at least 1, got 0"),
    (None, ["predict.annotations={photos}/none.json"], r"predict\.annotations: no such file: .*none\.json"),
    (None, ["predict.annotations={photos}/notes.txt"], r"predict\.annotations: .*notes\.txt: not readable as JSON"),
    (annotated, ["predict.annotations={photos}/labels.json"],
     r"predict\.annotations: .*labels\.json: categories \['go', 'stop', 'tree'\] are not objects.*predict\.categories"),
    (lambda photos: annotated(photos, categories=CATEGORIES[:2]), ["predict.annotations={photos}/labels.json", NAMED],
     r"predict\.categories: \['tree'\] are not categories of .*labels\.json, which has \["),
    (lambda photos: annotated(photos, images=[]), ["predict.annotations={photos}/labels.json", NAMED],
     r"predict\.annotations: .*labels\.json has no entry for any of the 4 pictures of predict\.images, such as a\.png"),
    (lambda photos: annotated(photos, images=[{"id": 100, "file_name": "a.png", "width": 12, "height": 9}]),
     ["predict.annotations={photos}/labels.json", NAMED], r"a\.png is listed with 12 x 9 pixels, .* has 120 x 90"),
    (lambda photos: annotated(photos, annotations=[{"image_id": 100, "category_id": 5, "bbox": [0, 0, 1, 1]}]),
     ["predict.annotations={photos}/labels.json", NAMED], r"json: category ids \[5\] of a\.png are not declared"),
]  # fmt: skip


@pytest.mark.parametrize(("prepare", "overrides", "message"), REFUSED)
def test_bad_input_is_one_line_with_key_and_file(prepare, overrides, message, photos, model, tmp_path):
    if prepare:
        prepare(photos)
    given = [word.replace("{photos}", str(photos)) for word in overrides]
    with pytest.raises((ValueError, UserError), match=message) as caught:
        predict(tmp_path / "out", f"predict.model={model}", f"predict.images={photos}", *given)
    assert "\n" not in str(caught.value)


def test_on_the_command_line_bad_input_ends_with_status_two(tmp_path):
    words = ["stages=[predict]", f"predict.images={tmp_path}", f"hydra.run.dir={tmp_path}/run"]
    done = subprocess.run(
        [sys.executable, "-m", "src.main", *words], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("neural-sim: predict.images: no picture")

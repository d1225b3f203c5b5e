"""Each format's files, against other readers, and the table of psi."""

import contextlib
import csv
import io
import json
import math

import numpy as np
import pytest
import torch
import yaml
from faster_coco_eval import COCO, COCOeval_faster
from PIL import Image

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.synthesis.export import bop
from neural_sim.synthesis.export.bop import depth_scale, diameter_of, object_ids
from neural_sim.synthesis.export.masks import mask_of
from neural_sim.synthesis.export.psi_table import psi_csv, psi_rows
from neural_sim.synthesis.export.yolo import write_yolo
from neural_sim.target.bop import BopTarget
from neural_sim.target.coco import CocoTarget
from neural_sim.target.frames import FrameName

# --- COCO ---


def scored(module_of_coco, evaluator, path, kind, tmp_path):
    """AP of a file's own annotations, taken as detections."""
    document = json.loads(path.read_text())
    keys = ("image_id", "category_id", "bbox" if kind == "bbox" else "segmentation")
    rows = [{key: item[key] for key in keys} | {"score": 1.0} for item in document["annotations"]]
    (tmp_path / "rows.json").write_text(json.dumps(rows))
    with contextlib.redirect_stdout(io.StringIO()):
        truth = module_of_coco(str(path))
        made = evaluator(truth, truth.loadRes(str(tmp_path / "rows.json")), kind)
        made.evaluate()
        made.accumulate()
        made.summarize()
    return made.stats[0]


@pytest.mark.parametrize("kind", ["bbox", "segm"])
def test_coco_scores_one_against_itself(whole, kind, tmp_path):
    assert scored(COCO, COCOeval_faster, whole[0] / "annotations.json", kind, tmp_path) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", ["bbox", "segm"])
def test_pycocotools_scores_one_too(whole, kind, tmp_path):
    coco = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    evaluation = pytest.importorskip("pycocotools.cocoeval", reason="pycocotools is not installed")
    path = whole[0] / "annotations.json"
    assert scored(coco.COCO, evaluation.COCOeval, path, kind, tmp_path) == pytest.approx(1.0)


def test_coco_boxes_areas_and_visibilities_are_those_of_the_masks(boxes, whole):
    root, _ = whole
    document, source = json.loads((root / "annotations.json").read_text()), boxes().source
    assert [image["id"] for image in document["images"]] == list(range(1, 8))
    assert {(image["width"], image["height"]) for image in document["images"]} == {(64, 48)}
    by_image = {number: [] for number in range(1, 8)}
    for item in document["annotations"]:
        by_image[item["image_id"]].append(item)
    assert len(document["annotations"]) > 5
    for number, items in by_image.items():
        shown = [item for item in source.image(number - 1).objects if item.labelled]
        assert len(shown) == len(items)
        for item, truth in zip(items, shown, strict=True):
            mask = mask_of(item["segmentation"])
            assert np.array_equal(mask, truth.visible) and np.array_equal(
                mask_of(item["segmentation_full"]), truth.full
            )
            rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            x, y, width, height = item["bbox"]
            assert (x, y) == (columns[0], rows[0]) and (x + width, y + height) == (
                columns[-1] + 1,
                rows[-1] + 1,
            )
            x0, y0, x1, y1 = truth.box
            assert item["bbox_full"] == [x0, y0, x1 - x0, y1 - y0] and item["area"] == mask.sum()
            assert item["visibility"] == pytest.approx(mask.sum() / truth.pixels)
            assert item["category_id"] == truth.placed.label + 1
    assert any(item["visibility"] < 1.0 for item in document["annotations"])
    loaded = CocoTarget(root / "annotations.json").load(list(source.scene.names), 48, 64)
    assert int(loaded.present.sum()) == len(document["annotations"])


# --- YOLO ---


def yolo_boxes(root, stem, size=(64, 48)):
    """Class and (x0, y0, x1, y1) in pixels by the format's description."""
    for line in (root / "labels" / f"{stem}.txt").read_text().splitlines():
        label, *numbers = line.split()
        values = np.array([float(number) for number in numbers])
        if len(values) == 4:
            x, y, width, height = values * [*size, *size]
            yield int(label), (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        else:
            corners = values.reshape(-1, 2) * size
            yield int(label), (*corners.min(0), *corners.max(0))


def coco_boxes(root):
    document = json.loads((root / "annotations.json").read_text())
    for image in document["images"]:
        items = [item for item in document["annotations"] if item["image_id"] == image["id"]]
        boxes = [(x, y, x + w, y + h) for x, y, w, h in (item["bbox"] for item in items)]
        yield image["file_name"], [item["category_id"] - 1 for item in items], boxes


def test_yolo_has_the_same_boxes_as_rectangles_and_as_polygons(whole):
    root, _ = whole
    for file, labels, wanted in coco_boxes(root):
        for place in (root, root / "segment"):
            stem = file.removeprefix("images/").removesuffix(".png")
            found = list(yolo_boxes(place, stem))
            assert [label for label, _ in found] == labels
            assert np.allclose([box for _, box in found], wanted, atol=1e-6)
            assert (place / file).read_bytes() == (root / file).read_bytes()
    lines = (root / "dataset.yaml").read_text().splitlines()
    assert lines[:2] == ["train: images", "val: images # no split is made; name your own"]
    assert lines[2:] == ["nc: 3", "names:", '  0: "tall"', '  1: "flat"', '  2: "long"']


@pytest.mark.parametrize("place", ["", "segment"])
def test_supervision_reads_the_same_boxes(whole, place):
    supervision = pytest.importorskip("supervision", reason="supervision is not installed")
    root = whole[0] / place
    with contextlib.redirect_stdout(io.StringIO()):
        data = supervision.DetectionDataset.from_yolo(
            str(root / "images"), str(root / "labels"), str(root / "dataset.yaml")
        )
    assert data.classes == ["tall", "flat", "long"]
    for file, labels, wanted in coco_boxes(whole[0]):
        found = data.annotations[str(root / file)]
        assert found.class_id.tolist() == labels
        assert np.allclose(found.xyxy, np.array(wanted).reshape(-1, 4), atol=1e-4)  # float32


@pytest.mark.parametrize("name", ["mug", 'a "quoted" \\ name', "café \x7f \u2028", "\U0001f600"])
def test_a_yaml_reader_takes_any_name(name, tmp_path):
    write_yolo(tmp_path, [], [name], {})
    read = yaml.safe_load((tmp_path / "dataset.yaml").read_text(encoding="utf-8"))
    assert read["names"] == {0: name}


# --- BOP ---


def test_bop_holds_every_field_of_the_format(boxes, whole):
    """docs/bop_datasets_format.md: millimetres, OpenCV axes, ids, counts, boxes by first and last pixels."""
    root, made = whole[0] / "bop", boxes()
    assert sorted(path.name for path in (root / "train").iterdir()) == ["000000", "000001"]
    infos = json.loads((root / "models" / "models_info.json").read_text())
    for number, model in enumerate(made.models, 1):
        info, points = infos[str(number)], np.asarray(model.mesh.vertices)
        assert [info[f"min_{axis}"] for axis in "xyz"] == pytest.approx(points.min(0))
        assert [info[f"size_{axis}"] for axis in "xyz"] == pytest.approx(np.ptp(points, axis=0))
        assert info["diameter"] == pytest.approx(np.linalg.norm(np.ptp(points, axis=0)))  # of a box
        assert (root / "models" / f"obj_{number:06d}.ply").read_bytes().startswith(b"ply\nformat ascii 1.0")
    for number in range(7):
        scene, own = root / "train" / f"{number // 4:06d}", number % 4
        gt, info, camera = (
            json.loads((scene / f"scene_{kind}.json").read_text())[str(own)]
            for kind in ("gt", "gt_info", "camera")
        )
        image = made.source.image(number)
        assert set(camera) == {"cam_K", "depth_scale"} and camera["depth_scale"] == 0.1
        focal = 24.0 / math.tan(math.radians(20.0))
        assert camera["cam_K"] == pytest.approx([focal, 0, 31.5, 0, focal, 23.5, 0, 0, 1])
        depth = np.asarray(Image.open(scene / "depth" / f"{own:06d}.png"))
        assert depth.dtype == np.uint16 and depth.shape == (48, 64)
        assert np.abs(depth * 0.1 - image.depth).max() <= 0.05 + 1e-4  # half a step
        picture = np.asarray(Image.open(scene / "rgb" / f"{own:06d}.png"))
        assert np.array_equal(picture, image.pixels)
        assert len(gt) == len(info) == len(image.objects)
        for index, (pose, held, item) in enumerate(zip(gt, info, image.objects, strict=True)):
            assert (
                set(pose) == {"cam_R_m2c", "cam_t_m2c", "obj_id"} and pose["obj_id"] == item.placed.label + 1
            )
            turn, model = np.array(pose["cam_R_m2c"]).reshape(3, 3), made.models[item.placed.label]
            assert np.abs(turn @ turn.T - np.eye(3)).max() < 1e-12 and np.linalg.det(turn) > 0
            centre = turn @ model.to_model[:3, 3] + pose["cam_t_m2c"]
            pixel = np.array(camera["cam_K"]).reshape(3, 3) @ centre
            assert pixel[:2] / pixel[2] == pytest.approx(np.array((31.5, 23.5)) + item.placed.shift)
            assert np.linalg.norm(centre) == pytest.approx(
                float(item.placed.draw.distance) * model.millimetres
            )
            masks = [
                np.asarray(Image.open(scene / kind / f"{own:06d}_{index:06d}.png"))
                for kind in ("mask", "mask_visib")
            ]
            assert all(set(np.unique(mask)) <= {0, 255} and mask.shape == (48, 64) for mask in masks)
            full, visible = (mask > 0 for mask in masks)
            assert np.array_equal(full, item.full) and np.array_equal(visible, item.visible)
            assert held["px_count_all"] == item.pixels >= full.sum()
            assert held["px_count_valid"] == ((depth > 0) & full).sum()
            assert held["px_count_visib"] == visible.sum()
            assert held["visib_fract"] == pytest.approx(visible.sum() / item.pixels if item.pixels else 0.0)
            if not visible.any():
                assert held["bbox_obj"] == held["bbox_visib"] == [-1, -1, -1, -1]
                continue
            rows, columns = np.flatnonzero(visible.any(1)), np.flatnonzero(visible.any(0))
            first, last = (columns[0], rows[0]), (columns[-1], rows[-1])
            assert held["bbox_visib"] == [*first, last[0] - first[0], last[1] - first[1]]
            x0, y0, x1, y1 = item.box
            assert held["bbox_obj"] == [x0, y0, x1 - 1 - x0, y1 - 1 - y0]


def test_the_diameter_is_the_largest_distance_also_of_what_is_flat_or_has_many_points(monkeypatch):
    """A sheet of paper has no convex hull in space."""
    points = np.random.default_rng(0).normal(size=(300, 3))
    longest = np.linalg.norm(points[:, None] - points, axis=-1).max()
    for at_once in (7, 1000):
        monkeypatch.setattr(bop, "AT_ONCE", at_once)
        assert diameter_of(points) == pytest.approx(longest)
    turn = np.linalg.qr(points[:3])[0]
    for flat, wanted in (
        ([[0.0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0], [1, 1, 0]], 5.0),
        ([[0.0, 0, 0], [3, 0, 0], [1, 0, 0]], 3.0),
        ([[1.0, 1, 1]], 0.0),
    ):
        assert diameter_of(np.array(flat) @ turn + 0.3) == pytest.approx(wanted)


def test_our_own_reader_takes_bop_back(boxes, whole):
    root, made = whole[0] / "bop", boxes()
    target = BopTarget(root, test="train", every=1)
    assert target.class_names == ["obj_000001", "obj_000002", "obj_000003"]
    for number in range(7):
        frame = target.reader.frame(FrameName(f"train/{number // 4:06d}", number % 4), depth=True)
        image = made.source.image(number)
        assert np.abs(frame.depth - image.depth * 1e-3).max() <= 0.5e-4 + 1e-7
        for found, item in zip(frame.objects, image.objects, strict=True):
            assert found.name == f"obj_{item.placed.label + 1:06d}"
            assert found.mask is not None and np.array_equal(found.mask, item.visible)
            assert found.visibility == pytest.approx(item.visible.sum() / item.pixels if item.pixels else 0.0)


def test_ids_are_those_of_bops_names():
    assert object_ids(["obj_000005", "obj_000002"]) == [5, 2]
    assert object_ids(["mug", "obj_000002"]) == [1, 2]
    assert object_ids(["obj_000002", "obj_2"]) == [1, 2]


def test_depth_reaches_as_far_as_it_must():
    for farthest in (0.5, 65.0, 66.0, 6553.0, 6554.0, 80000.0):
        scale = depth_scale(farthest)
        assert scale * 65535 >= farthest > 0.1 * scale * 65535
        assert math.log10(scale) == pytest.approx(round(math.log10(scale)))


# --- psi ---


def test_the_table_of_psi_draws_what_psi_draws(boxes):
    """Another sampler, from the CSV alone, against the project's own draws."""
    p = {"initial": {"dominant": 2}, "target": "uniform"}
    distribution = SceneDistribution.of([Pose(biased={"tall": p}), Zoom(biased={"tall": p})])
    psi, names = distribution.psi("initial", ["tall", "flat"]), ["tall", "flat"]
    rows = list(csv.DictReader(io.StringIO(psi_csv(psi_rows(distribution, psi, names)))))
    assert {row["object"] for row in rows} == set(names)
    random, drawn = np.random.default_rng(0), {}
    for coordinate in ("phi", "rho", "distance"):
        own = [row for row in rows if row["object"] == "tall" and row["coordinate"] == coordinate]
        assert sum(float(row["weight"]) for row in own) == pytest.approx(1.0)
        assert [int(row["bin"]) for row in own] == list(range(1, len(own) + 1))
        chosen = random.choice(len(own), 4000, p=[float(row["weight"]) for row in own])
        low, high = (np.array([float(row[end]) for row in own])[chosen] for end in ("low", "high"))
        within = random.random(4000)
        logarithmic = own[0]["spacing"] == "log"
        drawn[coordinate] = low * (high / low) ** within if logarithmic else low + (high - low) * within
    noise = distribution.draw_noise(4000, torch.Generator().manual_seed(1), torch.float64)
    truth = distribution.hard(psi[0], noise)
    for coordinate, values in drawn.items():
        own = getattr(truth, coordinate).numpy()
        own = own if coordinate == "distance" else np.degrees(own)
        at = np.sort(np.concatenate([own, values]))
        apart = np.abs(
            np.searchsorted(np.sort(own), at, "right") - np.searchsorted(np.sort(values), at, "right")
        ).max()
        # Kolmogorov and Smirnov: a distance above 1.95 sqrt(2 / n) has a probability of 0.001.
        assert apart / 4000 < 1.95 * math.sqrt(2 / 4000)

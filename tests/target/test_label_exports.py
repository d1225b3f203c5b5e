"""Labels as annotation tools export them: read right, or refused in one line that says what to do."""

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neural_sim.target.coco import CocoTarget
from neural_sim.target.photographs import PhotoFiles
from neural_sim.target.truth import Truth

BOXES = [[10.0, 15.0, 30.0, 20.0], [5.0, 4.0, 16.0, 40.0], [30.0, 20.0, 40.0, 30.0]]
Entries = list[dict[str, Any]]


def pictures(folder: Path, names: list[str]) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(names):
        pixels = np.random.default_rng(number).integers(0, 255, (60, 80, 3), np.uint8)
        Image.fromarray(pixels).save(folder / name, quality=95)
    return names


def document(files: list[str], first: int = 1, image: Any = None, **annotation: Any) -> dict[str, Any]:
    """A mug in each picture; ids count from ``first``, ``annotation`` is added to each box."""
    images: Entries = [
        {"id": first + n, "file_name": file, "width": 80, "height": 60, "license": 0, **(image or {})}
        for n, file in enumerate(files)
    ]
    annotations: Entries = [
        {"id": first + n, "image_id": first + n, "category_id": first, "bbox": box, "iscrowd": 0, "segmentation": [],
         "area": box[2] * box[3], **annotation}
        for n, box in enumerate(BOXES)
    ]  # fmt: skip
    return {"info": {}, "licenses": [], "images": images, "annotations": annotations,
            "categories": [{"id": first, "name": "mug", "supercategory": ""}]}  # fmt: skip


def written(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


NAMES = [f"{n:03d}.jpg" for n in range(3)]


def cvat(root: Path) -> Path:
    """annotations/ beside images/; every box has attributes."""
    made = document(pictures(root / "images", NAMES), attributes={"occluded": False, "rotation": 0.0},
                    image={"flickr_url": "", "coco_url": "", "date_captured": 0})  # fmt: skip
    return written(root / "annotations" / "instances_default.json", made)


def label_studio(root: Path) -> Path:
    """Ids from 0, names with the upload's prefix and the folder of Windows."""
    files = pictures(root / "images", [f"3ff4e0ab-{name}" for name in NAMES])
    return written(root / "result.json", document([f"images\\{file}" for file in files], first=0, ignore=0))


def label_studio_addresses(root: Path) -> Path:
    files = pictures(root / "images", NAMES)
    made = document([f"http://localhost:8080/data/upload/3/{file}" for file in files], first=0)
    return written(root / "result.json", made)


def roboflow(root: Path) -> Path:
    """A folder for each part, a category 0 for the project that has the name of the class, sizes as floats."""
    home = root / "train"
    made = document(pictures(home, [f"{n}_jpg.rf.8a2b.jpg" for n in range(3)]), first=1)
    made["categories"].insert(0, {"id": 0, "name": "mug", "supercategory": "none"})
    return written(home / "_annotations.coco.json", made)


def via(root: Path) -> Path:
    """Sizes that are not known, polygons without a list about them."""
    made = document(pictures(root, NAMES), first=0, image={"width": 0, "height": 0, "date_captured": ""})
    for item in made["annotations"]:
        item["segmentation"] = [0, 0, 10, 0, 10, 10]
    return written(root / "via_export_coco.json", made)


def converted_yolo(root: Path) -> Path:
    """As converters of Ultralytics' folders write it: ids as floats, no supercategory, names with folders."""
    made = document([f"images/val/{name}" for name in pictures(root / "images" / "val", NAMES)])
    for item in made["annotations"]:
        item["image_id"], item["category_id"] = float(item["image_id"]), 1.0
        del item["segmentation"]
    del made["categories"][0]["supercategory"], made["info"], made["licenses"]
    return written(root / "instances_val.json", made)


def run_lengths(root: Path) -> Path:
    made = document(pictures(root, NAMES), segmentation={"counts": [0, 4800], "size": [60, 80]})
    return written(root / "masks.json", made)


@pytest.mark.parametrize(
    "export", [cvat, label_studio, label_studio_addresses, roboflow, via, converted_yolo, run_lengths]
)
def test_exports_are_read_with_their_boxes(tmp_path: Path, export: Callable[[Path], Path]) -> None:
    path = export(tmp_path)
    found = CocoTarget(path).load(["mug"], 60, 80)
    assert found.boxes[:, 0].tolist() == [[x, y, x + w, y + h] for x, y, w, h in BOXES]
    folder = next(path for path in tmp_path.rglob("*.jpg")).parent
    truth = Truth(path, None, ["mug"], PhotoFiles(str(folder), "predict.images"))
    assert [truth.boxes(photo)[0][0].tolist() for photo in truth.photos.paths] == found.boxes[:, 0].tolist()


# --- what says something else than it seems ---


def test_turned_boxes_of_cvat_become_the_upright_ones_about_them(tmp_path: Path, caplog: Any) -> None:
    made = document(pictures(tmp_path, NAMES), attributes={"rotation": 90.0})
    with caplog.at_level(logging.WARNING):
        boxes = CocoTarget(written(tmp_path / "a.json", made)).load(["mug"], 60, 80).boxes[:, 0]
    assert np.allclose(boxes[0], [15, 10, 35, 40]) and "3 boxes are rotated" in caplog.text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"iscrowd": 1}, r"3 crowds are left out \(iscrowd=1, which CVAT also writes"),
        ({"bbox": [0, 0, 0, 0]}, "3 boxes without a width or a height are left out"),
    ],
)
def test_files_without_a_box_that_counts_are_refused(
    tmp_path: Path, caplog: Any, change: Any, said: str
) -> None:
    path = written(tmp_path / "a.json", document(pictures(tmp_path, NAMES), **change))
    with pytest.raises(ValueError, match=r"a\.json: has no usable box"):
        CocoTarget(path).load(["mug"], 60, 80)
    assert any(re.search(said, record.message) for record in caplog.records)


def test_a_box_like_that_of_a_crowd_counts(tmp_path: Path, caplog: Any) -> None:
    """CVAT writes iscrowd=1 for a mask, and an object may have a rectangle of the same size besides."""
    made = document(pictures(tmp_path, NAMES))
    made["annotations"] = [
        row for item in made["annotations"] for row in ({**item, "id": 100 + item["id"], "iscrowd": 1}, item)
    ]
    assert CocoTarget(written(tmp_path / "a.json", made)).load(["mug"], 60, 80).present.sum() == 3
    assert "repeat an earlier one" not in caplog.text


def test_boxes_that_come_twice_count_once_and_those_beyond_the_picture_are_told(
    tmp_path: Path, caplog: Any
) -> None:
    made = document(pictures(tmp_path, NAMES))
    made["annotations"] += [{**item, "id": 100 + item["id"]} for item in made["annotations"][:2]]
    made["annotations"][2]["bbox"] = [30, 20, 60, 30]
    found = CocoTarget(written(tmp_path / "a.json", made)).load(["mug"], 60, 80)
    assert found.present.sum() == 3 and "2 boxes repeat an earlier one and are left out" in caplog.text
    assert "1 of 5 boxes reach beyond their pictures and are clipped, such as annotations[2]" in caplog.text


@pytest.mark.parametrize(
    ("box", "reason"),
    [
        ([0.1, 0.2, 0.4, 0.5], "all boxes lie in the first pixel, .*in pixels, not fractions"),
        (
            [30, 25, 70, 55],
            "3 of 3 boxes reach beyond their pictures, but none would if its numbers were two",
        ),
        ([200, 200, 30, 30], "no box lies on its picture"),
    ],
)
def test_boxes_in_other_terms_are_refused(tmp_path: Path, box: list[float], reason: str) -> None:
    path = written(tmp_path / "a.json", document(pictures(tmp_path, NAMES), bbox=box))
    with pytest.raises(ValueError, match=rf"a\.json: {reason}"):
        CocoTarget(path)
    with pytest.raises(ValueError, match=rf"predict\.annotations: .*a\.json: {reason}"):
        Truth(path, None, ["mug"], PhotoFiles(str(tmp_path), "predict.images"))


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("data.yaml", "path: .\ntrain: images/train\nnames: [mug]\n", "YOLO format; want COCO's JSON: .*from_yolo"),
        ("annotations.xml", "<annotations/>", "Pascal VOC or CVAT format; want COCO's JSON"),
        ("ls.json", [{"id": 1, "data": {"image": "/data/a.jpg"}}], "this is Label Studio's own format: export as COCO"),
        ("results.json", [{"image_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}], "this is a list of detections"),
        ("via.json", {"_via_settings": {}, "_via_img_metadata": {}}, "this is VIA's project: export .* as COCO"),
        ("regions.json", {"a.jpg7": {"filename": "a.jpg", "regions": []}}, "this is VIA's own format"),
        ("labelme.json", {"shapes": [], "imagePath": "a.jpg"}, "this is labelme's format"),
        ("ml.json", [{"image": "a.jpg", "annotations": []}], "this is CreateML's format"),
        ("via_coco.json", document(NAMES) | {"annotations": [{"image_id": "0", "category_id": None, "bbox": BOXES[0]}]},
         r"annotations\[0\]\.category_id: want a whole number or a text, got None"),
    ],
)  # fmt: skip
def test_formats_of_other_kinds_are_named(tmp_path: Path, name: str, content: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}.*{reason}"):
        CocoTarget(written(tmp_path / name, content))


def test_a_folder_is_refused_with_the_files_that_may_be_meant(tmp_path: Path) -> None:
    written(tmp_path / "yolo" / "data.yaml", "names: [mug]")
    roboflow(tmp_path / "flow")
    with pytest.raises(
        ValueError, match=r"target\.annotations: .*data\.yaml belongs to a data set in YOLO format"
    ):
        CocoTarget(tmp_path / "yolo")
    with pytest.raises(
        ValueError, match=r"flow is a folder, want its COCO file: train/_annotations\.coco\.json"
    ):
        CocoTarget(tmp_path / "flow")


def test_names_of_another_machine_are_refused_with_what_to_do(tmp_path: Path) -> None:
    files = pictures(tmp_path, NAMES)
    path = written(tmp_path / "a.json", document([f"/data/upload/1/{file}" for file in files]))
    with pytest.raises(
        ValueError, match=r"'/data/upload/1/000\.jpg' .*leads out of .*start from target\.images"
    ):
        CocoTarget(path)

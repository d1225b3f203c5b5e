"""COCO files as tools write them, checked as a whole: the wrong entry is named, for targets and predictions alike."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neural_sim.target.classes import ClassMap
from neural_sim.target.coco import CocoTarget
from neural_sim.target.coco_file import CocoFile
from neural_sim.target.photographs import PhotoFiles
from neural_sim.target.truth import Truth

NAMES = ["can", "mug"]
BOX = [10, 15, 30, 30]


def photo(seed: int) -> Image.Image:
    """Noise of 80 x 60 with a red block at x 10 to 40, y 15 to 45."""
    pixels = np.random.default_rng(seed).integers(0, 120, (60, 80, 3), np.uint8)
    pixels[15:45, 10:40] = (230, 30, 30)
    return Image.fromarray(pixels)


class Made:
    """Photographs and their document, to be changed and written."""

    def __init__(self, folder: Path, count: int = 4) -> None:
        self.folder = folder
        self.images: list[dict[str, Any]] = [
            {"id": i + 1, "file_name": f"{i:03d}.png", "width": 80, "height": 60} for i in range(count)
        ]
        self.annotations: list[dict[str, Any]] = [
            {"id": i + 1, "image_id": i + 1, "category_id": 1, "bbox": list(BOX)} for i in range(count)
        ]
        self.categories: list[dict[str, Any]] = [{"id": 1, "name": "mug"}]
        for entry in self.images:
            photo(entry["id"]).save(folder / entry["file_name"])

    def written(self, encoding: str = "utf-8") -> Path:
        keys = ("images", "annotations", "categories")
        path = self.folder / "labels.json"
        path.write_text(json.dumps({key: getattr(self, key) for key in keys}), encoding=encoding)
        return path

    def boxes(self, **settings: Any) -> list[Any]:
        return CocoTarget(self.written(), **settings).load(NAMES, 60, 80).boxes.tolist()

    def truth(self) -> Truth:
        return Truth(self.written(), None, NAMES, PhotoFiles(str(self.folder), "predict.images"))

    def refused(self, message: str) -> None:
        """By the target, and by what scores predictions."""
        with pytest.raises(ValueError, match=rf"labels\.json.*{message}") as error:
            self.boxes()
        assert "\n" not in str(error.value)
        with pytest.raises(ValueError, match=rf"predict\.annotations: .*labels\.json.*{message}"):
            self.truth().boxes(self.folder / "000.png")


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return Made(tmp_path)


PLAIN = [[[10, 15, 40, 45]]] * 4


def test_a_plain_file_is_read(made: Made, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "neural_sim.target.coco_file"):
        assert made.boxes() == PLAIN
    assert not [record for record in caplog.records if record.name.endswith("coco_file")]


# --- pictures ---


def turn(made: Made, **sizes: Any) -> None:
    """Store the photographs turned, with EXIF that shows them upright."""
    exif = Image.Exif()
    exif[0x0112] = 6
    for entry in made.images:
        entry.update(file_name=entry["file_name"].replace("png", "jpg"), **sizes)
        stored = photo(entry["id"]).transpose(Image.Transpose.ROTATE_90)
        stored.save(made.folder / entry["file_name"], exif=exif, quality=95, subsampling=0)


def red(image: Any) -> list[int]:
    rows, columns = np.nonzero((image[0] - image[1]).numpy() > 0.5)
    return [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]


def test_labels_of_upright_pictures_lie_on_their_objects(made: Made) -> None:
    turn(made)
    images = CocoTarget(made.written()).load(NAMES, 60, 80)
    for image, boxes in zip(images.images, images.boxes.tolist(), strict=True):
        assert np.abs(np.subtract(red(image), boxes[0])).max() <= 1


def test_labels_of_stored_pictures_are_refused(made: Made) -> None:
    turn(made, width=60, height=80)
    with pytest.raises(
        ValueError,
        match=r"000\.jpg.* listed with 60 x 80 pixels, but has 80 x 60; its EXIF orientation 6 shows",
    ):
        CocoTarget(made.written())


def test_turned_pictures_without_a_listed_size_are_warned_of(
    made: Made, caplog: pytest.LogCaptureFixture
) -> None:
    turn(made, width=None, height=0)
    with caplog.at_level(logging.WARNING):
        assert made.boxes() == PLAIN
    assert "4 photographs are turned by EXIF and listed without width and height, such as" in caplog.text


def test_other_sizes_and_damaged_pictures_are_refused_before_any_is_read(made: Made) -> None:
    made.images[2]["width"] = 160
    with pytest.raises(ValueError, match=r"002\.png .*listed with 160 x 60 pixels, but has 80 x 60"):
        CocoTarget(made.written())
    made.images[2]["width"] = 80
    (made.folder / "003.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"003\.png \(named in .*labels\.json\): not a readable image"):
        CocoTarget(made.written())


# --- ids ---


def test_an_id_of_several_images_is_refused(made: Made) -> None:
    for entry in made.images:
        entry["id"] = 20250116
    for item in made.annotations:
        item["image_id"] = 20250116
    made.refused(r"images\[0\] and \[1\] \('000\.png' and '001\.png'\) have the same id, 20250116")


def test_a_file_of_several_images_is_refused(made: Made) -> None:
    made.images[3]["file_name"] = "000.png"
    made.refused(r"images\[0\] and \[3\] \(1 and 4\) have the same file_name, '000\.png'")


def test_a_file_of_several_images_is_refused_in_any_spelling(made: Made) -> None:
    made.images[3]["file_name"] = "./000.png"
    made.refused(r"images\[0\] and \[3\] \(1 and 4\) have the same file_name, '\./000\.png'")


def test_an_id_of_several_categories_is_refused(made: Made) -> None:
    made.categories.append({"id": 1, "name": "can"})
    made.refused(r"categories\[0\] and \[1\] \('mug' and 'can'\) have the same id, 1")


def test_ids_of_another_type_are_refused_where_no_annotation_has_an_image(made: Made) -> None:
    for item in made.annotations:
        item["image_id"] = str(item["image_id"])
    made.refused(
        r"no annotation is of an image that it lists: annotations\[0\]\.image_id is '1', images\[0\]\.id is 1"
    )


def test_some_annotations_without_an_image_are_counted(made: Made, caplog: pytest.LogCaptureFixture) -> None:
    made.annotations += [{"image_id": 99, "category_id": 1, "bbox": BOX}] * 3
    with caplog.at_level(logging.WARNING):
        assert made.boxes() == PLAIN
    assert (
        "3 of 7 annotations are of images that it does not list, such as annotations[4].image_id is 99"
        in caplog.text
    )


def test_ids_may_be_texts_and_of_both_kinds(made: Made) -> None:
    made.images[0]["id"] = made.annotations[0]["image_id"] = "a"
    assert made.boxes() == PLAIN
    made.images[1]["id"] = 2.0  # as pandas writes it
    assert made.boxes() == PLAIN


@pytest.mark.parametrize("id", [None, [1], True, 1.5, {"a": 1}, float("nan")])
@pytest.mark.parametrize("place", ["images[0].id", "annotations[0].image_id", "annotations[0].category_id"])
def test_ids_that_are_none_are_refused(made: Made, id: Any, place: str) -> None:
    section, key = place.split("[0].")
    getattr(made, section)[0][key] = id
    with pytest.raises(ValueError, match=rf"{section}\[0\]\.{key}: want a whole number or a text, got"):
        CocoFile.read(made.written())


# --- boxes ---


@pytest.mark.parametrize(
    "box",
    [
        None, ["10", "15", "30", "30"], ["a", 1, 2, 3], [float("nan"), 1, 2, 3], [1, 2, float("inf"), 3],
        [40, 45, -30, -30], [[10, 15, 30, 30]], 7, "1234", [], [1, 2, 3], [1, 2, 3, 4, 5], [1, 2, True, 4],
        {"x": 1, "y": 2, "width": 3, "height": 4}, [1, 2, 3, 10**400],
    ],
)  # fmt: skip
def test_boxes_are_four_finite_numbers(made: Made, box: Any) -> None:
    made.annotations[2]["bbox"] = box
    made.refused(r"annotations\[2\]\.bbox must be x, y, width, height: four finite numbers, .* got")


def test_a_polygon_without_a_box_is_refused(made: Made) -> None:
    del made.annotations[1]["bbox"]
    made.refused(r"annotations\[1\] lacks \['bbox'\]")


def test_boxes_without_a_side_are_counted(made: Made, caplog: pytest.LogCaptureFixture) -> None:
    """As COCO's own training set has them."""
    made.annotations.append({"image_id": 1, "category_id": 1, "bbox": [10, 10, 0, 5]})
    with caplog.at_level(logging.WARNING):
        assert made.boxes(minimum_side=0.0) == PLAIN
    assert "1 boxes without a width or a height are left out" in caplog.text
    assert made.truth().boxes(made.folder / "000.png")[0].tolist() == PLAIN[0]


@pytest.mark.parametrize("crowd", ["0", 2, [], "false"])
def test_crowds_are_flags(made: Made, crowd: Any) -> None:
    made.annotations[0]["iscrowd"] = crowd
    made.refused(r"annotations\[0\]\.iscrowd: want 0 or 1, got")


# --- names ---


def test_names_with_backslashes_are_read(made: Made) -> None:
    (made.folder / "images").mkdir()
    for entry in made.images:
        (made.folder / entry["file_name"]).rename(made.folder / "images" / entry["file_name"])
        entry["file_name"] = "images\\" + entry["file_name"]
    assert made.boxes(split_by=r"/(\d+)") == PLAIN
    assert len(made.truth().entries) == 4


def test_a_file_whose_own_name_has_a_backslash_is_read(made: Made) -> None:
    """As unzip leaves what was packed on Windows."""
    (made.folder / "000.png").rename(made.folder / "images\\000.png")
    made.images[0]["file_name"] = "images\\000.png"
    assert made.boxes() == PLAIN


def test_names_in_unicodes_other_form_are_read(made: Made) -> None:
    (made.folder / "000.png").rename(made.folder / "Scha\u0308ufele.png")
    made.images[0]["file_name"] = "Sch\u00e4ufele.png"
    assert made.boxes() == PLAIN


@pytest.mark.parametrize("name", ["../000.png", "/etc/hostname", "..\\000.png", "a/../../000.png"])
def test_names_do_not_leave_their_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "below").mkdir()
    made = Made(tmp_path / "below")
    photo(1).save(tmp_path / "000.png")
    made.images[0]["file_name"] = name
    with pytest.raises(ValueError, match=r"labels\.json: file_name .* of image 1 leads out of .*below"):
        CocoTarget(made.written())
    made.images[0]["file_name"] = str(made.folder / "000.png")
    assert made.boxes() == PLAIN


@pytest.mark.parametrize("name", [7, None, "", ["a.png"]])
def test_names_of_files_are_texts(made: Made, name: Any) -> None:
    made.images[1]["file_name"] = name
    made.refused(r"images\[1\]\.file_name: want the name of a file, got")


def test_a_byte_order_mark_is_read(made: Made) -> None:
    assert CocoTarget(made.written("utf-8-sig")).load(NAMES, 60, 80).boxes.tolist() == PLAIN


# --- categories ---


def test_categories_without_annotations_are_left_out(made: Made, caplog: pytest.LogCaptureFixture) -> None:
    made.categories.insert(0, {"id": 0, "name": "shelf-objects", "supercategory": "none"})
    with caplog.at_level(logging.WARNING):
        assert made.boxes() == PLAIN
        assert made.truth().boxes(made.folder / "000.png")[0].tolist() == PLAIN[0]
    assert (
        caplog.text.count("categories ['shelf-objects'] are not objects and have no annotation: left out")
        == 2
    )


def test_categories_with_annotations_that_are_no_objects_are_still_refused(made: Made) -> None:
    made.categories.append({"id": 2, "name": "dog"})
    made.annotations[0]["category_id"] = 2
    made.refused(r"categories \['dog'\] are not objects")


def test_names_of_categories_may_be_numbers(made: Made) -> None:
    made.categories[0]["name"] = 7
    file = CocoFile.read(made.written())
    assert file.category_names == ["7"]
    classes = ClassMap({"7": "mug"}, "here")
    assert file.by_id(classes.labels(file.category_names, NAMES)) == {1: 1}
    made.categories[0]["name"] = None
    made.refused(r"categories\[0\]\.name: want a name, got None")

import json
import logging
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from PIL import Image

from neural_sim.objects.mesh import normalise
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.synthesis.subjects import MeshSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.coco import CocoTarget
from neural_sim.types import LabelledImages, PinholeCamera

NAMES = ["can", "mug"]


def write(folder: Path, **changes: Any) -> Path:
    """A white photo of 40 x 20 with a mug, a crowd and a speck, and a black one of 10 x 30 with nothing."""
    Image.new("RGB", (40, 20), "white").save(folder / "wide.png")
    Image.new("L", (10, 30)).save(folder / "tall.png")

    def item(box: list[float], **more: Any) -> dict[str, Any]:
        return {"image_id": 2, "category_id": 7, "bbox": box, **more}

    document = {
        "images": [{"id": 9, "file_name": "tall.png"}, {"id": 2, "file_name": "wide.png"}],
        "categories": [{"id": 7, "name": "mug"}],
        "annotations": [
            item([4, 2, 20, 10]), item([0, 0, 40, 20], iscrowd=1), item([1, 1, 0.5, 9]), item([30, 10, 20, 5]),
        ],
        **changes,
    }  # fmt: skip
    path = folder / "annotations.json"
    path.write_text(json.dumps(document))
    return path


def test_letterboxed_images_and_boxes_by_hand(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """At 80 x 80 the wide photo is doubled and lies in rows 20 to 60."""
    with caplog.at_level(logging.WARNING):
        loaded = CocoTarget(write(tmp_path)).load(NAMES, 80, 80)
    assert loaded.boxes[0].tolist() == [
        [8, 24, 48, 44],
        [60, 40, 80, 50],
    ]  # the second is clipped at the edge
    assert loaded.labels.tolist() == [[1, 1], [-1, -1]]
    assert loaded.images[0, :, 20:60].eq(1.0).all()
    assert loaded.images[0, :, :20].eq(0.5).all()
    assert loaded.images[0, :, 60:].eq(0.5).all()
    inside = loaded.images[1].eq(0.0).all(0)
    assert inside[:, 27 - 1 : 27 + 26].any(0).sum() == 27  # round(10 * 80 / 30)
    assert inside.any(1).all()
    assert loaded.bins.tolist() == [-1, -1]
    assert (
        "1 boxes with a side below 2 px or outside their photographs are dropped" in caplog.text
        and "no category for object can" in caplog.text
    )


def test_round_trip_through_the_export(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(3)
    corner = 20 * torch.rand(4, 2, 2, generator=generator)
    boxes = torch.cat([corner, corner + 4 + 20 * torch.rand(4, 2, 2, generator=generator)], -1)
    labels = torch.tensor([[0, 1], [1, 1], [0, 0], [1, 0]])
    images = torch.rand(4, 3, 48, 56, generator=generator)
    drawn = LabelledImages(images, boxes, labels, torch.arange(4))
    loaded = CocoTarget(write_coco(drawn, NAMES, tmp_path)).load(NAMES, 48, 56)
    torch.testing.assert_close(loaded.boxes, boxes, atol=1e-4, rtol=0)
    torch.testing.assert_close(loaded.images, images, atol=0.5 / 255 + 1e-6, rtol=0)
    assert torch.equal(loaded.labels, labels)


def test_categories_can_be_renamed_or_left_out(tmp_path: Path) -> None:
    path = write(tmp_path, categories=[{"id": 7, "name": "cup"}, {"id": 8, "name": "dog"}])
    with pytest.raises(ValueError, match=r"categories \['cup'\] are not objects.*target\.categories"):
        CocoTarget(path).load(NAMES, 80, 80)
    loaded = CocoTarget(path, categories={"cup": "mug", "dog": None}).load(NAMES, 80, 80)
    assert loaded.labels[0].tolist() == [1, 1]
    left_out = CocoTarget(path, categories={"cup": None, "dog": None}).load(NAMES, 80, 80)
    assert not left_out.present.any()
    with pytest.raises(
        ValueError, match=r"target\.categories: \['cat'\] are not categories of .*annotations\.json"
    ):
        CocoTarget(path, categories={"cup": "mug", "dog": None, "cat": "can"}).load(NAMES, 80, 80)


def test_categories_that_are_no_objects_can_be_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Their boxes are counted, the photographs stay."""
    boxes = [
        {"image_id": 2, "category_id": id, "bbox": [4, y, 20, 10]}
        for id, y in ((7, 2), (8, 2), (8, 4), (8, 4))
    ]
    boxes += [{"image_id": 2, "category_id": 8, "bbox": [0, 0, 30, 20], "iscrowd": 1}]
    path = write(tmp_path, categories=[{"id": 7, "name": "mug"}, {"id": 8, "name": "dog"}], annotations=boxes)
    with caplog.at_level(logging.INFO):
        loaded = CocoTarget(path, unmatched="leave_out").load(NAMES, 80, 80)
    assert loaded.labels.tolist() == [[1], [-1]]
    assert "boxes of categories that are not objects left out: {'dog': 2}" in caplog.text


def test_images_may_lie_elsewhere_and_be_limited(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    path = write(photos).rename(tmp_path / "labels.json")
    assert len(CocoTarget(path, images=photos, limit=1).load(NAMES, 16, 16)) == 1
    with pytest.raises(ValueError, match=r"wide\.png \(named in .*labels\.json\): not a readable image"):
        CocoTarget(path).load(NAMES, 16, 16)


def test_the_digest_follows_the_contents_of_labels_and_photos(tmp_path: Path) -> None:
    path = write(tmp_path)
    digests = [CocoTarget(path).digest(), CocoTarget(path, limit=1).digest()]
    photo = tmp_path / "wide.png"
    held = bytearray(photo.read_bytes())
    held[-1] ^= 1  # the size stays
    photo.write_bytes(held)
    digests.append(CocoTarget(path).digest())
    write(tmp_path, annotations=[{"image_id": 2, "category_id": 7, "bbox": [4, 2, 20, 10]}])
    digests.append(CocoTarget(path).digest())
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


BOTH = [
    {"image_id": image, "category_id": 7, "bbox": box}
    for image, box in ((2, [4, 2, 20, 10]), (2, [30, 10, 10, 5]), (9, [1, 2, 8, 20]))
]
"""Boxes on both photographs of ``write``."""


def sets_of(target: CocoTarget, seed: int = 3) -> dict[str, LabelledImages]:
    camera, synthesizer = PinholeCamera(24, 16, 0.7), Synthesizer(ProceduralClutter(), shift=0.0)
    renderer = RaycastRenderer()
    box = trimesh.creation.box()
    boxes = {name: MeshSubject(name, normalise(box, name, "test").mesh, renderer) for name in NAMES}
    return target.sets(boxes, SceneDistribution.of([Pose()]), camera, synthesizer, seed)


def test_sets_split_the_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        made = sets_of(CocoTarget(write(tmp_path, annotations=BOTH), val_fraction=0.5))
    assert {name: part.images.shape for name, part in made.items()} == {
        "val": (1, 3, 16, 24), "test": (1, 3, 16, 24),
    }  # fmt: skip
    assert {len(made[name].labels[made[name].present]) for name in made} == {1, 2}
    assert "look like" not in caplog.text


def test_a_part_without_a_box_is_refused(tmp_path: Path) -> None:
    """One of the two photographs shows nothing: scores on it alone would say nothing."""
    with pytest.raises(
        ValueError, match=r"annotations\.json: no photograph of (val|test) has a box of an object"
    ):
        sets_of(CocoTarget(write(tmp_path), val_fraction=0.5))
    with pytest.raises(ValueError, match=r"annotations\.json: no photograph of val or test has a box"):
        sets_of(CocoTarget(write(tmp_path, annotations=BOTH), categories={"mug": None}, val_fraction=0.5))


def test_boxes_outside_their_photograph_are_dropped_at_any_smallest_side(tmp_path: Path) -> None:
    """At a smallest side of 0, a box that was clipped to a line would be left."""
    outside = [{"image_id": 2, "category_id": 7, "bbox": [50, 5, 9, 9]}]
    loaded = CocoTarget(write(tmp_path, annotations=[*BOTH, *outside]), minimum_side=0.0).load(NAMES, 80, 80)
    assert loaded.present.sum(1).tolist() == [2, 1]


SCENES = {"kitchen": 5, "hall": 4, "yard": 3}


def videos(folder: Path) -> Path:
    """Frames of three scenes, each a picture of its own under a camera that moves by a pixel in forty; the blue of
    each pixel in the middle row says which scene."""
    generator, images, annotations = torch.Generator().manual_seed(7), [], []
    for scene, (name, count) in enumerate(SCENES.items()):
        (folder / name).mkdir()
        large = ProceduralClutter().draw(1, 60, 60, generator)[0]
        large[2, 20:40] = (scene + 1) / 4
        for frame in range(count):
            pixels = (255 * large[:, 10 : 10 + 40, frame : frame + 40]).byte().movedim(0, -1).numpy()
            Image.fromarray(pixels).save(folder / name / f"{frame}.png")
            number = len(images)
            images.append({"id": number, "file_name": f"{name}/{frame}.png", "scene": scene})
            annotations.append({"image_id": number, "category_id": 7, "bbox": [8, 8, 20, 20]})
    document = {"images": images, "categories": [{"id": 7, "name": "mug"}], "annotations": annotations}
    path = folder / "val.json"
    path.write_text(json.dumps(document))
    return path


def scenes_in(part: LabelledImages) -> list[int]:
    blue = part.images[:, 2, part.images.shape[2] // 2, part.images.shape[3] // 2]
    return (4 * blue - 1).round().long().tolist()


@pytest.mark.parametrize("split_by", [r"^(\w+)/", "attribute:scene"])
def test_frames_of_a_scene_stay_together(
    tmp_path: Path, split_by: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = videos(tmp_path)
    with caplog.at_level(logging.INFO):
        made = sets_of(CocoTarget(path, val_fraction=0.3, split_by=split_by))
    # Of 12 images 4 are wanted: the hall's. 3.6 is nearer to 4 than to the yard's 3.
    assert scenes_in(made["val"]) == [1] * 4
    assert sorted(scenes_in(made["test"])) == [0] * 5 + [2] * 3
    assert "makes 3 groups; val has 4 of 12 images (val_fraction 0.3)" in caplog.text
    assert "look like" not in caplog.text


def test_frames_of_a_scene_in_both_parts_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = videos(tmp_path)
    with caplog.at_level(logging.WARNING):
        made = sets_of(CocoTarget(path))
    shared = set(scenes_in(made["val"])) & set(scenes_in(made["test"]))
    alike = sum(scene in shared for scene in scenes_in(made["test"]))
    assert alike and f"val.json: {alike} of 8 test images look like one of val (" in caplog.text
    assert "keep them in one part by target.split_by" in caplog.text


def test_groups_are_checked_before_any_photo_is_read(tmp_path: Path) -> None:
    path = videos(tmp_path)
    for wrong in ("(", r"^(\d+)/", "attribute:video"):
        with pytest.raises(ValueError, match=r"^target\.split_by=.*val\.json: "):
            CocoTarget(path, split_by=wrong)
    with pytest.raises(ValueError, match=r"want at least two groups, got \['kitchen'\]"):
        CocoTarget(path, split_by=r"^(\w+)/", limit=5)


def tagged(folder: Path, annotation: Any, image: Any, key: str = "pose") -> Path:
    """Two mugs in the wide photo, of which the first has its own ``key``, and the photo's ``key``."""
    own = {} if annotation is None else {key: annotation}
    items = [{"image_id": 2, "category_id": 7, "bbox": [4, 2, 20, 10], **own},
             {"image_id": 2, "category_id": 7, "bbox": [10, 2, 20, 10]},
             {"image_id": 2, "category_id": 7, "bbox": [1, 1, 0.5, 9], key: 5}]  # fmt: skip
    entries = [{"id": 9, "file_name": "tall.png"}, {"id": 2, "file_name": "wide.png"}]
    entries[1] |= {} if image is None else {key: image}
    return write(folder, images=entries, annotations=items)


def test_pose_bins_are_an_attribute_of_annotations_or_images(tmp_path: Path) -> None:
    """From 1 in the file, from 0 inside; the speck of bin 5 is dropped with its bin."""

    def bins(path: Path, attribute: str = "pose") -> list[list[int]]:
        return CocoTarget(path, bin_attribute=attribute).load(NAMES, 80, 80).bins.tolist()

    assert bins(tagged(tmp_path, 3, 8)) == [[2, 7], [-1, -1]]
    assert bins(tagged(tmp_path, 3, None)) == [[2, -1], [-1, -1]]
    nested = tagged(tmp_path, {"pose": 1}, {"pose": 2}, "attributes")
    document = json.loads(nested.read_text())
    document["annotations"][2]["attributes"] = {"pose": 5}
    nested.write_text(json.dumps(document))
    assert bins(nested, "attributes.pose") == [[0, 1], [-1, -1]]
    assert CocoTarget(nested).load(NAMES, 80, 80).bins.tolist() == [-1, -1]


def test_pose_bins_that_are_none_are_refused(tmp_path: Path) -> None:
    for wrong in (0, 2.5, "side", True):
        with pytest.raises(
            ValueError, match=r"bin_attribute='pose': want a whole number of at least 1, annotations\[0\] or"
        ):
            CocoTarget(tagged(tmp_path, wrong, None), bin_attribute="pose")
    with pytest.raises(
        ValueError, match=r"annotations\.json: target\.bin_attribute='side': no annotation and no image has"
    ):
        CocoTarget(tagged(tmp_path, 3, 8), bin_attribute="side")
    with pytest.raises(
        ValueError, match=r"bin_attribute='pose': bin 9 of an annotation is beyond the 8 of pose"
    ):
        sets_of(CocoTarget(tagged(tmp_path, 3, 9), bin_attribute="pose", val_fraction=0.5))
    target = CocoTarget(tagged(tmp_path, 3, 8), bin_attribute="pose")
    found = target.photographs(NAMES, SceneDistribution.of([Pose()]))
    assert [photograph.bins.tolist() for photograph in found if photograph.bins is not None] == [
        [2, 7, 4],
        [],
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": []}, "has no images"),
        ({"annotations": None}, "want a list 'annotations'"),
        ({"images": [{"id": 1}]}, r"images\[0\] lacks \['file_name'\]"),
        ({"annotations": [{"image_id": 2, "category_id": 7, "bbox": [1, 2]}]}, "bbox must be"),
        ({"annotations": [{"image_id": 2, "category_id": 70, "bbox": [1, 2, 3, 4]}]}, r"ids \[70\] of wide"),
    ],
)
def test_malformed_files_are_refused_with_path_and_place(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=rf"annotations\.json.*{message}"):
        CocoTarget(write(tmp_path, **changes)).load(NAMES, 16, 16)


def test_what_is_no_json_or_no_file(tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    with pytest.raises(ValueError, match=r"broken\.json: not readable as JSON"):
        CocoTarget(broken).load(NAMES, 16, 16)
    with pytest.raises(ValueError, match=r"no such file: .*nowhere"):
        CocoTarget(tmp_path / "nowhere.json")


@pytest.mark.parametrize("seed", range(3))
def test_a_part_for_training_is_taken_from_what_is_not_scored_in_whole_groups(
    tmp_path: Path, seed: int
) -> None:
    """Which photographs are scored does not depend on it."""
    settings = {"val_fraction": 0.7, "split_by": "attribute:scene"}
    path = videos(tmp_path)
    without, made = (sets_of(CocoTarget(path, train_fraction=part, **settings), seed) for part in (None, 0.5))
    assert set(without) == {"val", "test"} and set(made) == {"train", "val", "test"}
    assert torch.equal(made["test"].images, without["test"].images)
    scenes = {part: set(scenes_in(images)) for part, images in made.items()}
    assert all(len(own) == 1 for own in scenes.values()) and set.union(*scenes.values()) == {0, 1, 2}
    assert len(made["train"]) + len(made["val"]) == len(without["val"])


def test_photographs_for_training_that_look_like_scored_ones_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    target = CocoTarget(videos(tmp_path), val_fraction=0.5, train_fraction=0.5)
    with caplog.at_level(logging.WARNING):
        made = sets_of(target)
    assert {name: len(part) for name, part in made.items()} == {"train": 3, "val": 3, "test": 6}
    for first, second in (("train", "val"), ("train", "test"), ("val", "test")):
        if set(scenes_in(made[first])) & set(scenes_in(made[second])):
            assert f"{second} images look like one of {first} (" in caplog.text

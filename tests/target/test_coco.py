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
from neural_sim.synthesis.export import write_coco
from neural_sim.synthesis.training_set import Synthesizer
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
    assert "1 boxes shorter than 2 px dropped" in caplog.text
    assert "no category for object can" in caplog.text


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
    with pytest.raises(ValueError, match=r"categories \['cup', 'dog'\] are no objects.*target\.categories"):
        CocoTarget(path).load(NAMES, 80, 80)
    loaded = CocoTarget(path, categories={"cup": "mug", "dog": None}).load(NAMES, 80, 80)
    assert loaded.labels[0].tolist() == [1, 1]
    left_out = CocoTarget(path, categories={"cup": None, "dog": None}).load(NAMES, 80, 80)
    assert not left_out.present.any()
    with pytest.raises(ValueError, match=r"\['cat'\] are not in the file"):
        CocoTarget(path, categories={"cup": "mug", "dog": None, "cat": "can"}).load(NAMES, 80, 80)


def test_images_may_lie_elsewhere_and_be_limited(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    path = write(photos).rename(tmp_path / "labels.json")
    assert len(CocoTarget(path, images=photos, limit=1).load(NAMES, 16, 16)) == 1
    with pytest.raises(ValueError, match=r"wide\.png \(named in .*labels\.json\): not a readable image"):
        CocoTarget(path).load(NAMES, 16, 16)


def test_the_digest_follows_labels_and_photos(tmp_path: Path) -> None:
    path = write(tmp_path)
    digests = [CocoTarget(path).digest(), CocoTarget(path, limit=1).digest()]
    Image.new("RGB", (41, 20), "red").save(tmp_path / "wide.png")
    digests.append(CocoTarget(path).digest())
    write(tmp_path, annotations=[])
    digests.append(CocoTarget(path).digest())
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_sets_split_the_file(tmp_path: Path) -> None:
    camera, synthesizer = PinholeCamera(24, 16, 0.7), Synthesizer(ProceduralClutter())
    meshes = {name: normalise(trimesh.creation.box(), name, "test") for name in NAMES}
    target = CocoTarget(write(tmp_path), val_fraction=0.5)
    made = target.sets(meshes, RaycastRenderer(), SceneDistribution.of([Pose()]), camera, synthesizer, seed=3)
    assert {name: part.images.shape for name, part in made.items()} == {
        "val": (1, 3, 16, 24), "test": (1, 3, 16, 24),
    }  # fmt: skip
    assert {len(made[name].labels[made[name].present]) for name in made} == {0, 2}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": []}, "holds no images"),
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


def test_what_is_no_json_and_bad_settings(tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    with pytest.raises(ValueError, match=r"broken\.json: not readable as JSON"):
        CocoTarget(broken).load(NAMES, 16, 16)
    with pytest.raises(ValueError, match=r"no such file: .*nowhere"):
        CocoTarget(tmp_path / "nowhere.json")
    with pytest.raises(ValueError, match="val_fraction must lie in"):
        CocoTarget(broken, val_fraction=1.0)
    with pytest.raises(ValueError, match="limit must be at least 1 or null, got 0"):
        CocoTarget(broken, limit=0)

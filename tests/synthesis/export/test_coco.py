import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from faster_coco_eval import COCO
from PIL import Image

from neural_sim.synthesis.export.coco import write_coco
from neural_sim.types import LabelledImages


@pytest.fixture
def drawn() -> LabelledImages:
    """Three images: two boxes, one box, none."""
    boxes = torch.tensor(
        [[[1.0, 2.0, 5.0, 9.0], [0.0, 0.0, 12.0, 10.0]], [[3.25, 1.5, 4.0, 8.0], [0.0] * 4], [[0.0] * 4] * 2]
    )
    images = torch.rand(3, 3, 10, 12, generator=torch.Generator().manual_seed(1))
    labels = torch.tensor([[1, 0], [0, -1], [-1, -1]])
    return LabelledImages(images, boxes, labels, torch.tensor([5, 0, 7]))


def test_an_independent_reader_finds_the_same_boxes_and_pixels(drawn: LabelledImages, tmp_path: Path) -> None:
    path = write_coco(drawn, ["can", "mug"], tmp_path / "set")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(path))
    assert [entry["name"] for entry in coco.loadCats(coco.getCatIds())] == ["can", "mug"]
    assert len(coco.getImgIds()) == 3
    for row, image_id in enumerate(sorted(coco.getImgIds())):
        entry = coco.loadImgs([image_id])[0]
        assert (entry["height"], entry["width"]) == (10, 12)
        pixels = np.asarray(Image.open(path.parent / entry["file_name"]), dtype=np.float32) / 255
        assert np.abs(pixels - drawn.images[row].movedim(0, -1).numpy()).max() <= 0.5 / 255 + 1e-6
        found = coco.loadAnns(coco.getAnnIds(imgIds=[image_id]))
        present = drawn.present[row]
        assert [item["category_id"] - 1 for item in found] == drawn.labels[row][present].tolist()
        for item, box in zip(found, drawn.boxes[row][present].tolist(), strict=True):
            x, y, width, height = item["bbox"]
            assert [x, y, x + width, y + height] == pytest.approx(box)
            assert item["area"] == pytest.approx((box[2] - box[0]) * (box[3] - box[1]))
            assert item["iscrowd"] == 0


def test_every_image_holds_the_poses_of_its_objects(drawn: LabelledImages, tmp_path: Path) -> None:
    poses = [
        [{"category_id": 1, "phi": 0.5}, {"category_id": 2, "phi": 1.0}],
        [{"category_id": 1, "phi": 1.5}],
        [],
    ]
    document = json.loads(write_coco(drawn, ["can", "mug"], tmp_path, poses).read_text())
    assert [entry["poses"] for entry in document["images"]] == poses
    assert [entry["bin"] for entry in document["images"]] == [5, 0, 7]
    assert {"info", "licenses", "categories", "images", "annotations"} == set(document)


def test_values_outside_the_range_are_clipped_not_wrapped(drawn: LabelledImages, tmp_path: Path) -> None:
    extreme = LabelledImages(
        torch.tensor([-0.2, 1.3])[:, None, None, None].expand(2, 3, 10, 12),
        drawn.boxes[:2], drawn.labels[:2], drawn.bins[:2],
    )  # fmt: skip
    write_coco(extreme, ["can", "mug"], tmp_path)
    ends = [np.asarray(Image.open(tmp_path / "images" / f"{row:06d}.png")) for row in (0, 1)]
    assert ends[0].max() == 0
    assert ends[1].min() == 255


def test_bad_exports_are_refused_before_anything_is_written(drawn: LabelledImages, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"label 1 has no name among \['can'\]"):
        write_coco(drawn, ["can"], tmp_path)
    with pytest.raises(ValueError, match="poses has 2 rows for 3 images"):
        write_coco(drawn, ["can", "mug"], tmp_path, [[], []])
    assert not list(tmp_path.iterdir())

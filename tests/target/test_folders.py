"""Photographs in one folder per class: how they are read, split and refused."""

import logging

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from neural_sim.objects.mesh import normalise
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.subjects import MeshSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.folders import FolderTarget
from neural_sim.types import PinholeCamera

NAMES = ["can", "mug"]


def write(root, counts=(("can", 6), ("mug", 4)), size=(20, 40)):
    """Photographs of noise; those of a class lie in two folders, by turns, the dark ones in a, the bright ones in b."""
    random = np.random.default_rng(len(counts))
    for name, count in counts:
        for number in range(count):
            path = root / name / "ab"[number % 2] / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = random.integers(0, 120, (*size, 3), np.uint8) + 130 * (number % 2)
            Image.fromarray(pixels.astype(np.uint8)).save(path)
    return root


def sets_of(target, names=NAMES, seed=3, camera=None):
    renderer, box = RaycastRenderer(), trimesh.creation.box()
    objects = {name: MeshSubject(name, normalise(box, name, "test").mesh, renderer) for name in names}
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.0)
    distribution = SceneDistribution.of([Pose()])
    return target.sets(objects, distribution, camera or PinholeCamera(24, 16, 0.7), synthesizer, seed)


def classes_of(parts):
    """The classes of all images, of one object each."""
    assert all(images.labels.shape[1] == 1 for images in parts.values())
    return sorted(label for images in parts.values() for label in images.labels[:, 0].tolist())


def test_every_photograph_is_in_one_part_with_its_folder_s_class(tmp_path):
    parts = sets_of(FolderTarget(write(tmp_path), train_fraction=0.5, val_fraction=0.4))
    assert {part: len(images) for part, images in parts.items()} == {"train": 2, "val": 2, "test": 6}
    assert classes_of(parts) == [0] * 6 + [1] * 4
    whole = torch.cat([images.images for images in parts.values()])
    assert whole.shape == (10, 3, 16, 24) and len({image.numpy().tobytes() for image in whole}) == 10
    again = sets_of(FolderTarget(tmp_path, train_fraction=0.5, val_fraction=0.4))
    assert all(torch.equal(parts[part].images, again[part].images) for part in parts)
    assert not torch.equal(
        sets_of(FolderTarget(tmp_path), seed=4)["test"].images, sets_of(FolderTarget(tmp_path))["test"].images
    )


def test_a_box_is_the_whole_photograph_and_borders_are_cut_off(tmp_path):
    """A red frame of 2 pixels round 8 x 4 white ones, on 16 x 16 pixels: doubled, in rows 4 to 12."""
    for name in NAMES:
        (tmp_path / name).mkdir()
        picture = np.zeros((8, 12, 3), np.uint8)
        picture[..., 0], picture[2:-2, 2:-2] = 255, 255
        picture[2, 2] = 0 if name == "can" else 9  # so that the two differ
        Image.fromarray(picture).save(tmp_path / name / "photo.png")
    parts = sets_of(FolderTarget(tmp_path, border=2, val_fraction=0.5), camera=PinholeCamera(16, 16, 0.7))
    for images in parts.values():
        assert images.boxes.tolist() == [[[0.0, 4.0, 16.0, 12.0]]]
        assert images.images[0, :, 4:12, 4:].eq(1.0).all() and images.images[0, :, :4].eq(0.5).all()
    with pytest.raises(
        ValueError, match=r"target\.border: 4 leaves nothing of .*photo\.png, which has 12 x 8 pixels"
    ):
        sets_of(FolderTarget(tmp_path, border=4))


def test_folders_are_mapped_left_out_or_refused(tmp_path, caplog):
    write(tmp_path, (("cup", 3), ("dog", 2), ("can", 2)))
    with pytest.raises(
        ValueError, match=r"folders \['cup', 'dog'\] are not objects; .*target\.unmatched=leave_out"
    ):
        sets_of(FolderTarget(tmp_path))
    kept = FolderTarget(tmp_path, {"cup": "mug", "dog": None})
    assert classes_of(sets_of(kept)) == [0, 0, 1, 1, 1]
    listed = FolderTarget(tmp_path, {"cup": "mug"}, unmatched="leave_out")
    with caplog.at_level(logging.WARNING):
        assert classes_of(sets_of(listed)) == [1, 1, 1]
    assert "no folder for object can, which gets no score" in caplog.text
    own = FolderTarget(tmp_path, unmatched="leave_out", val_fraction=0.5)
    assert classes_of(sets_of(own)) == [0, 0]
    with pytest.raises(ValueError, match=r"no folder is one of the objects \['mug'\]"):
        sets_of(own, names=["mug"])


def test_groups_stay_together_and_a_limit_spreads(tmp_path):
    write(tmp_path)
    together = FolderTarget(tmp_path, split_by=r"^\w+/(\w)/", val_fraction=0.5)
    parts = sets_of(together)
    for images in parts.values():  # letterboxed, so that the sides are grey
        inside = images.images[:, :, 6:10, 8:16].mean((1, 2, 3))
        assert bool((inside < 0.5).all()) or bool((inside > 0.5).all())
    assert sorted(len(images) for images in parts.values()) == [5, 5]
    few = FolderTarget(tmp_path, limit=2)
    assert [path.name for _, path in few._taken(["can"])] == ["0.png", "1.png"]  # of a/0 a/2 a/4 b/1 b/3 b/5
    with pytest.raises(ValueError, match="want a regular expression or null, got 'attribute:scene'"):
        FolderTarget(tmp_path, split_by="attribute:scene")
    with pytest.raises(ValueError, match="want at least two groups"):
        FolderTarget(tmp_path, split_by=r"\.png$")


def test_equal_photographs_stay_together_and_near_ones_are_warned_of(tmp_path, caplog):
    write(tmp_path, (("can", 8), ("mug", 2)), (96, 96))
    first = Image.open(tmp_path / "can" / "a" / "0.png").resize((12, 12)).resize((96, 96))
    for number in range(8):  # a slow film
        pixels = np.asarray(first).astype(int) + number
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(
            tmp_path / "can" / "ab"[number % 2] / f"{number}.png"
        )
    with caplog.at_level(logging.WARNING):
        sets_of(FolderTarget(tmp_path), camera=PinholeCamera(96, 96, 0.7))
    assert "look like one of val" in caplog.text and "target.split_by" in caplog.text


def test_the_digest_follows_the_photographs_that_are_taken(tmp_path):
    write(tmp_path)
    target = FolderTarget(tmp_path, {"mug": None})
    before = target.digest()
    (tmp_path / "mug" / "a" / "0.png").unlink()
    assert FolderTarget(tmp_path, {"mug": None}).digest() == before
    (tmp_path / "can" / "a" / "0.png").unlink()
    assert FolderTarget(tmp_path, {"mug": None}).digest() != before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"root": "nowhere"}, r"target\.root: no such folder: nowhere; put photographs there"),
        ({"classes": {"dog": "mug"}}, r"target\.classes: \['dog'\] are not folders of .*\['can', 'mug'\]"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        FolderTarget(**({"root": write(tmp_path)} | settings))


def test_folders_without_photographs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="has no folders, want one for each class"):
        FolderTarget(tmp_path)
    (tmp_path / "can").mkdir()
    with pytest.raises(ValueError, match=r"target\.root: no picture"):
        FolderTarget(tmp_path)
    (tmp_path / "can" / "broken.png").write_bytes(b"no picture")
    (tmp_path / "can" / "other.png").write_bytes(b"none")
    with pytest.raises(ValueError, match=r"target\.root: .*broken\.png: not a readable image"):
        sets_of(FolderTarget(tmp_path))

"""``neural-sim sample``: data that the tutorial can be followed with, read back by the readers of a user's data."""

import json
import re

import numpy as np
import pytest
from composing import composed
from PIL import Image

from neural_sim.main import UserError, context_of
from neural_sim.objects.folder import MeshFolder
from neural_sim.tasks.walk import walk

SMALL = [
    "+experiment=sample_data", "progress=false", "views.count=9", "views.image_size=48", "target.val_per_object=8",
    "target.test_per_object=2", "target.test_per_biased_object=2", "sample.frames=5", "views.backend=raycast",
]  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("sample")


def _context(base, *overrides):
    paths = [f"paths.store={base / 'store'}", f"sample.folder={base / 'shelf'}"]
    return context_of(composed(*SMALL, *paths, *overrides), base / "run")


@pytest.fixture(scope="module")
def made(base):
    context, tasks = _context(base)
    walk(context, tasks)
    return context, base / "shelf"


def test_captures_are_read_back_with_their_cameras_and_masks(made):
    context, shelf = made
    read, _ = context_of(
        composed("objects=photos", f"objects.root={shelf / 'captures'}", "stages=[views]"), shelf
    )
    source = read.experiment.imaging.objects
    assert source.names() == ["drill", "pitcher"]
    for stage in context.graph.views:
        views, frames = context.results(stage), source.captures[stage.object].frames
        assert len(frames) == len(views) == 9 and source.captures[stage.object].up == (0.0, 0.0, 1.0)
        for frame, pose, image in zip(frames, views.camera_to_world, views.images, strict=True):
            assert np.allclose(frame.camera_to_world, pose.numpy(), atol=1e-6)
            assert np.array_equal(np.asarray(Image.open(frame.image)), image.mul(255).round().byte().numpy())
        assert frames[0].lens.fx == pytest.approx(48 / (2 * np.tan(np.radians(20))))


def test_labels_are_those_of_the_target_in_folders_that_stand_for_videos(made):
    context, shelf = made
    labelled = context.results(context.graph.targets).val
    document = json.loads((shelf / "labels.json").read_text())
    files = [image["file_name"] for image in document["images"]]
    assert len(files) == len(labelled) and len(document["annotations"]) == int(labelled.present.sum())
    assert all(re.fullmatch(r"video\d\d/00[0-4]\.png", name) and (shelf / name).is_file() for name in files)
    first = np.asarray(Image.open(shelf / files[6])).astype(float) / 255
    assert np.abs(first - labelled.images[6].movedim(0, -1).numpy()).max() <= 0.5 / 255 + 1e-6
    words = ["target=coco", f"target.annotations={shelf / 'labels.json'}", "target.split_by='^(\\w+)/'"]
    words += ["camera=from_target", "objects=photos", f"objects.root={shelf / 'captures'}"]
    read, _ = context_of(composed(*words), shelf)
    assert (read.graph.camera.width, read.graph.camera.height) == (160, 120)
    assert read.graph.camera.field_of_view == pytest.approx(context.graph.camera.field_of_view)


def test_meshes_and_pictures_without_labels_are_there_too(made):
    context, shelf = made
    meshes = {item.name: item for item in MeshFolder(shelf / "meshes").load()}
    for name, item in context.graph.objects.items.items():
        assert meshes[name].radius == pytest.approx(item.radius, rel=1e-5)
    assert len(list((shelf / "new").glob("*.png"))) == len(context.results(context.graph.targets).test)


def test_a_folder_that_is_there_is_left_alone(made, base):
    context, tasks = _context(base)
    with pytest.raises(UserError, match=r"sample\.folder: \S+shelf exists; want a new folder"):
        walk(context, tasks)
    context, tasks = _context(
        base, f"sample.folder={base / 'other'}", "objects=photos", f"objects.root={base / 'shelf'}/captures"
    )
    with pytest.raises(UserError, match="want objects from meshes"):
        walk(context, tasks)

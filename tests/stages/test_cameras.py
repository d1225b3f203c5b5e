"""Found cameras as a stage: made once, stored, told again; and what is asked for by the command line."""

import logging
import shutil
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from captures import capture
from composing import composed

from neural_sim.main import context_of
from neural_sim.objects.capture import Capture
from neural_sim.objects.found import FoundCapture
from neural_sim.objects.motion import Colmap
from neural_sim.objects.photos import Photos
from neural_sim.renderer.views import Views
from neural_sim.stages.cameras import with_cameras
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store
from neural_sim.stages.views import Captures


@dataclass(frozen=True)
class Known:
    """Finds the cameras that the photographs were made with, but that of the third."""

    level: int = 0
    truth: ClassVar[Capture]
    searches: ClassVar[list[list[bool]]] = []

    def find(self, album, mask, progress=False):
        self.searches.append([mask(shot) is not None for shot in album.shots])
        images = [shot.image for shot in album.shots]
        frames = tuple(
            type(frame)(image, frame.camera_to_world, frame.lens)
            for number, (image, frame) in enumerate(zip(images, self.truth.frames, strict=True))
            if number != 2
        )
        found = Capture(album.name, frames, album.folder, tuple(images), (0.0, -1.0, 0.0))
        return FoundCapture(found, 0.4, 321, (album.called(album.shots[2]),))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Photographs with masks and nothing else."""
    made = capture(tmp_path_factory.mktemp("given"), count=12, width=64, height=48)
    Known.truth = Photos(made.folder).captures["can"]
    root = tmp_path_factory.mktemp("alone")
    for part in ("images", "masks"):
        shutil.copytree(made.folder / part, root / "can" / part)
    return root


def placed(root, store, finder, **options):
    return with_cameras(Photos(root, poses=finder, **options), Results(Store(store)))


def test_cameras_are_found_once_and_told_of_again(alone, tmp_path, caplog):
    Known.searches.clear()
    objects = Captures(placed(alone, tmp_path, Known()))
    stage = objects.stage("can", Views(8, 2, 32))
    assert len(Results(Store(tmp_path))(stage)) == 9 and stage.held_out == 1  # an eighth of eleven scores
    caplog.clear()
    with caplog.at_level(logging.INFO):
        capture_ = placed(alone, tmp_path, Known()).captures["can"]
    assert Known.searches == [[True] * 12]
    assert (
        "can: found the cameras of 11 of 12 photographs, with 321 points and a mean error of 0.40"
        in caplog.text
    )
    assert "left out: images/002.png" in caplog.text
    kept = [frame for number, frame in enumerate(Known.truth.frames) if number != 2]
    assert [frame.image.name for frame in capture_.frames] == [frame.image.name for frame in kept]
    assert all(a.lens == b.lens for a, b in zip(capture_.frames, kept, strict=True))
    for one, other in zip(capture_.frames, kept, strict=True):
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)
    assert capture_.up == (0.0, -1.0, 0.0)


def test_cameras_depend_on_photographs_and_finder_alone(alone, tmp_path):
    Known.searches.clear()
    first = placed(alone, tmp_path / "store", Known())
    assert placed(alone, tmp_path / "store", Known(), up="+x", size=0.2).digests() != first.digests()
    shutil.copytree(alone / "can", tmp_path / "root" / "can")
    assert placed(tmp_path / "root", tmp_path / "store", Known()).digests() == first.digests()
    assert len(Known.searches) == 1
    placed(alone, tmp_path / "store", Known(1))
    assert len(Known.searches) == 2


def test_the_command_line_asks_for_them(alone, tmp_path, monkeypatch):
    words = ["objects/poses=colmap", "objects.refinement.rounds=3", "objects.poses.features=900"]
    where = [f"objects.root={alone}", f"paths.store={tmp_path}/store", f"paths.mlflow={tmp_path}/mlflow.db"]
    config = composed("objects=photos", "scale=smoke", "stages=[views]", *words, *where)
    monkeypatch.setattr(Colmap, "find", lambda self, *more: Known().find(*more))
    stage = context_of(config, tmp_path)[0].graph.views[0]
    assert stage.refinement.rounds == 3 and stage.objects.source.poses == Colmap(features=900)
    assert len(stage.objects.source.captures["can"].frames) == 11
    given = composed("objects=photos", "scale=smoke", "stages=[views]", *where)
    with pytest.raises(ValueError, match="objects/poses=colmap finds cameras"):
        context_of(given, tmp_path)

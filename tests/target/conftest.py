"""A small data set in YCB-Video's layout, written once for all tests that read it and anew for those that change it."""

import pytest
from posed_scenes import meshes_in_metres, photographs, write_ycb_video

from neural_sim.target.ycb_video import CLASSES

OBJECTS = {"035_power_drill": "drill", "025_mug": "mug", "019_pitcher_base": "pitcher"}


@pytest.fixture(scope="module")
def meshes():
    return meshes_in_metres(OBJECTS)


@pytest.fixture(scope="module")
def made(meshes):
    """Three scenes of three frames; the last scene shows one object alone, whose poses MATLAB stores as 3 x 4."""
    return [
        *photographs(meshes, 2, 3),
        *(_of_scene(item, 2) for item in photographs(meshes, 1, 3, 1, seed=4)),
    ]


def _of_scene(item, scene):
    return type(item)(**{**vars(item), "scene": scene})


@pytest.fixture(scope="module")
def shared_root(made, meshes, tmp_path_factory):
    """Frames that no test changes."""
    return write_ycb_video(tmp_path_factory.mktemp("ycb_video"), made, meshes, CLASSES, hdf5=(1, 2))


@pytest.fixture
def root(made, meshes, tmp_path):
    return write_ycb_video(tmp_path, made, meshes, CLASSES)

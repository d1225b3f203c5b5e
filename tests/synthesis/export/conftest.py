"""Scenes of solid boxes in closed form: fields without fitting, whose surfaces are known."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
import trimesh
from small_export import data_of

from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.export.bop import Model
from neural_sim.synthesis.export.images import ImageSource
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import FieldSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import PinholeCamera

CELL, STEP_CELLS, RAW = 0.125, 0.05, 20.0
# In object radii: a sample stands for so much of a ray, and half of the light is lost so deep.
STEP, DEEP = CELL * STEP_CELLS, math.log(2.0) * CELL / (2.0 * RAW)
SIDES = {"tall": (3, 3, 6), "flat": (6, 5, 1), "long": (2, 6, 2)}  # half sides in cells, x, y, z
MILLIMETRES = {"tall": 100.0, "flat": 60.0, "long": 80.0}
CAMERA = PinholeCamera(64, 48, math.radians(40.0))


def solid(half: tuple[int, int, int], colour: float) -> GridField:
    """A box of one colour, dense up to its faces."""
    field = GridField(step_cells=STEP_CELLS)
    occupied = torch.zeros(16, 16, 16, dtype=torch.bool)
    occupied[tuple(slice(8 - side, 8 + side) for side in half)] = True
    field.reset(occupied, torch.full((3,), -1.0), CELL)
    with torch.no_grad():
        field.table[:-1, 0] = RAW
        field.table[:-1, 1:] = torch.tensor([colour, -colour, 0.5 * colour])
    return field.eval().requires_grad_(False)


def mesh_of(name: str) -> trimesh.Trimesh:
    """The same box in its normalised frame."""
    return trimesh.creation.box([2.0 * CELL * side for side in SIDES[name]])


@dataclass(frozen=True)
class Boxes:
    source: ImageSource
    models: tuple[Model, ...]


@pytest.fixture(scope="session")
def boxes() -> Callable[..., Boxes]:
    def make(
        count: tuple[int, int] = (0, 3),
        camera: PinholeCamera = CAMERA,
        seed: int = 3,
        shift: float = 0.4,
        distribution: SceneDistribution | None = None,
        names: tuple[str, ...] = tuple(SIDES),
    ) -> Boxes:
        distribution = SceneDistribution.of([Pose()]) if distribution is None else distribution
        renderer = NerfRenderer(termination=0.0)
        subjects = tuple(
            FieldSubject(name, solid(SIDES[name], 1.0 - i), renderer) for i, name in enumerate(names)
        )
        synthesizer = Synthesizer(
            ProceduralClutter(octaves=1, shapes=2), shift=shift, minimum_area=4.0, objects_per_image=count
        )
        scene = Scene(subjects, CAMERA, synthesizer, distribution)
        psi = torch.zeros(len(names), distribution.size, dtype=torch.float64)
        models = []
        for number, name in enumerate(names):
            frame = np.diag([MILLIMETRES[name]] * 3 + [1.0])  # the mesh's own origin is off its centre
            frame[:3, 3] = (5.0 * number, -7.0, 11.0)
            models.append(Model(name, MILLIMETRES[name], frame, mesh_of(name).apply_transform(frame)))
        source = ImageSource(scene, psi, camera, tuple(MILLIMETRES[name] for name in names), seed)
        return Boxes(source, tuple(models))

    return make


@pytest.fixture(scope="module")
def whole(boxes, tmp_path_factory):
    """Seven images in all formats, and their records."""
    root = tmp_path_factory.mktemp("export") / "data"
    return root, data_of(boxes, root).write(lambda numbers: numbers)

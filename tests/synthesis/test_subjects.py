"""Scenes of meshes or other subjects: the same draws as those of the fields, and the images of the subjects."""

import math

import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.subject import FieldSubject
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.draws import RelaxedDraws
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import SubjectScene
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(24, 24, math.radians(40.0))
PSI = torch.zeros(2, 4)


def _block(seed):
    field = GridField().eval()
    field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
    noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        field.table.copy_(noise + 1.0)
    return field.requires_grad_(False)


def scene(objects_per_image=(1, 1)):
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.2, objects_per_image=objects_per_image)
    distribution = SceneDistribution.of([Pose(bins=4)])
    return Scene(("a", "b"), (_block(1), _block(2)), NerfRenderer(), CAMERA, synthesizer, distribution)


class Flat:
    """An opaque square of half the image's sides in one colour, which remembers its cameras."""

    radius = None

    def __init__(self, name, colour):
        self.name, self.colour, self.poses = name, colour, []

    def render(self, camera, camera_to_world, lighting=None):
        self.poses.append(camera_to_world)
        rgba = torch.zeros(len(camera_to_world), camera.height, camera.width, 4)
        rgba[:, 6:18, 6:18] = torch.tensor([*self.colour, 1.0])
        return rgba


@pytest.mark.parametrize("objects_per_image", [(1, 1), (1, 2)])
def test_subjects_that_are_the_fields_give_the_fields_images(objects_per_image):
    """The same generator: poses, backgrounds, places. Straight alpha and back costs some float32 rounding."""
    plain = scene(objects_per_image)
    shown = tuple(FieldSubject(n, f) for n, f in zip(plain.names, plain.fields, strict=True))
    one, other = (
        each.training_set(PSI, 5, torch.Generator().manual_seed(3))
        for each in (plain, SubjectScene.of(plain, shown))
    )
    torch.testing.assert_close(other.images.images, one.images.images, rtol=0.0, atol=1e-5)
    assert torch.equal(other.images.labels, one.images.labels)
    assert torch.equal(other.images.boxes, one.images.boxes) and torch.equal(
        other.images.bins, one.images.bins
    )


def test_a_subject_is_seen_from_the_poses_of_the_draw():
    plain, flat = scene(), (Flat("a", (1.0, 0.0, 0.0)), Flat("b", (0.0, 0.0, 1.0)))
    made = SubjectScene.of(plain, flat).training_set(PSI, 3, torch.Generator().manual_seed(0))
    for label, subject in enumerate(flat):
        draw = made.objects[label].draw
        assert torch.equal(torch.cat(subject.poses), orbit(draw.phi, draw.rho, draw.distance))
        x0, y0, x1, y1 = made.images.boxes[3 * label, 0].int().tolist()
        inside = made.images.images[3 * label, :, y0:y1, x0:x1]
        assert torch.equal(inside, torch.tensor(subject.colour)[:, None, None].expand_as(inside))


def test_what_a_mesh_has_not_is_refused():
    plain, flat = scene(), (Flat("a", (1.0, 0.0, 0.0)), Flat("b", (0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match="want 2 subjects, got 1"):
        SubjectScene.of(plain, flat[:1])
    with pytest.raises(ValueError, match="hard draws"):
        SubjectScene.of(plain, flat).drawn(0, PSI[0], 2, torch.Generator(), RelaxedDraws())

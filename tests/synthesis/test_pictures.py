"""Scenes of pictures in the place of fields: which pictures, how large, and where they were taken."""

import math

import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.field.grid import GridField
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.pictures import PictureScene
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import PinholeCamera, PosedViews

SMALL = PinholeCamera(12, 12, math.radians(40.0))


def scene(objects_per_image=(1, 1), width=24):
    """Two objects, whose fields nothing renders."""
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.2, objects_per_image=objects_per_image)
    camera = PinholeCamera(width, 24, math.radians(40.0))
    distribution = SceneDistribution.of([Pose(bins=4)])
    return Scene(("a", "b"), (GridField(), GridField()), NerfRenderer(), camera, synthesizer, distribution)


def views(colour, phi=(0.3, 1.0, 2.0), distance=3.0):
    """A three quarters opaque square in the middle of each picture, half as wide as it."""
    images = torch.zeros(len(phi), 12, 12, 4)
    images[:, 3:9, 3:9] = torch.tensor([*colour, 0.75])
    angles = torch.tensor(phi)
    return PosedViews(
        images, orbit(angles, torch.full_like(angles, -1.0), torch.full_like(angles, distance)), SMALL
    )


@pytest.mark.parametrize("objects_per_image", [(1, 1), (1, 2)])
def test_training_images_show_the_pictures_whatever_psi_is(objects_per_image):
    shown = PictureScene.of(scene(objects_per_image), [views((1.0, 0.0, 0.0)), views((0.0, 1.0, 0.0))])
    one, other = (
        shown.training_set(psi, 6, torch.Generator().manual_seed(0)).images
        for psi in (torch.zeros(2, 4), torch.tensor([[9.0, 0.0, 0.0, 0.0]] * 2))
    )
    assert torch.equal(one.images, other.images) and len(one) == 12
    assert (one.bins == -1).all() and one.present.any(1).all()
    sizes = (one.boxes[..., 2:] - one.boxes[..., :2])[one.present]
    # A square of 12 of 24 pixels, its edge blurred, shifted or hidden.
    assert sizes.max() <= 14.0 and sizes.min() > 2.0


def test_a_picture_keeps_its_place_and_its_colour_is_premultiplied():
    shown = PictureScene.of(scene(), [views((1.0, 0.0, 0.0)), views((0.0, 1.0, 0.0))])
    part = shown.drawn(1, torch.zeros(4), 5, torch.Generator())
    middle = part.rgb[:, 9:15, 9:15]
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.75, 0.0]).expand_as(middle))
    torch.testing.assert_close(part.opacity[:, 12, 12], torch.full((5,), 0.75))
    assert not part.opacity[:, :4].any() and not part.opacity[:, :, 20:].any()


def test_a_draw_says_from_where_the_picture_was_taken():
    shown = PictureScene.of(scene(), [views((1.0, 0.0, 0.0)), views((0.0, 1.0, 0.0), (0.7,), 2.5)])
    draw = shown.drawn(1, torch.zeros(4), 2, torch.Generator()).draw
    torch.testing.assert_close(draw.phi, torch.full((2,), 0.7))
    torch.testing.assert_close(draw.rho, torch.full((2,), -1.0))
    torch.testing.assert_close(draw.distance, torch.full((2,), 2.5))


def test_pictures_fit_into_wide_images_without_being_stretched():
    shown = PictureScene.of(scene(width=36), [views((1.0, 0.0, 0.0)), views((0.0, 1.0, 0.0))])
    opacity = shown.pictures[0][0, ..., 3]
    assert opacity.shape == (24, 36)
    inside = (opacity > 0.4).nonzero()
    assert inside.amin(0).tolist() == [6, 12] and inside.amax(0).tolist() == [17, 23]


def test_another_number_of_views_than_objects_is_refused():
    with pytest.raises(ValueError, match="2 objects"):
        PictureScene.of(scene(), [views((1.0, 0.0, 0.0))])

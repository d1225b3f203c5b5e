"""Subjects of scenes: meshes and pictures at the draws of fields, what they show, and what they refuse."""

import dataclasses
import math

import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.field.grid import GridField
from neural_sim.objects.procedural import Procedural
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import RelaxedDraws, SceneDistribution
from neural_sim.parameter.unlearned import Unlearned
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.pictures import PictureSubject
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import (
    FieldSubject,
    MeshSubject,
    PhotographedField,
    RenderedSubject,
)
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.types import Maps, PinholeCamera, PosedViews

CAMERA = PinholeCamera(24, 24, math.radians(40.0))
SMALL = PinholeCamera(12, 12, math.radians(40.0))
PSI = torch.zeros(2, 4)


def _block(seed):
    field = GridField().eval()
    field.reset(torch.ones(4, 4, 4, dtype=torch.bool), torch.full((3,), -0.6), 0.3)
    noise = torch.randn(field.table.shape, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        field.table.copy_(noise + 1.0)
    return field.requires_grad_(False)


def scene(objects_per_image=(1, 1), subjects=None, camera=CAMERA):
    synthesizer = Synthesizer(ProceduralClutter(), shift=0.2, objects_per_image=objects_per_image)
    subjects = subjects or tuple(
        FieldSubject(name, _block(seed), NerfRenderer()) for name, seed in (("a", 1), ("b", 2))
    )
    return Scene(subjects, camera, synthesizer, SceneDistribution.of([Pose(bins=4)]))


class Flat(RenderedSubject):
    """An opaque square of half the image's sides in one colour, which remembers its cameras."""

    def __init__(self, name, colour):
        super().__init__(name)
        object.__setattr__(self, "colour", colour)
        object.__setattr__(self, "poses", [])

    def maps(self, camera, camera_to_world, weights=None):
        self.poses.append(camera_to_world)
        rgb = torch.zeros(len(camera_to_world), camera.height, camera.width, 3)
        rgb[:, 6:18, 6:18] = torch.tensor(self.colour)
        opacity = torch.zeros(rgb.shape[:-1])
        opacity[:, 6:18, 6:18] = 1.0
        return Maps(rgb, opacity)


def flats():
    return Flat("a", (1.0, 0.0, 0.0)), Flat("b", (0.0, 0.0, 1.0))


def views(colour, phi=(0.3, 1.0, 2.0), distance=3.0):
    """A three quarters opaque square in the middle of each picture, half as wide as it."""
    images = torch.zeros(len(phi), 12, 12, 4)
    images[:, 3:9, 3:9] = torch.tensor([*colour, 0.75])
    angles = torch.tensor(phi)
    return PosedViews(
        images, orbit(angles, torch.full_like(angles, -1.0), torch.full_like(angles, distance)), SMALL
    )


def pictures(one=None, other=None, camera=CAMERA):
    one, other = one or views((1.0, 0.0, 0.0)), other or views((0.0, 1.0, 0.0))
    return PictureSubject.of("a", one, camera), PictureSubject.of("b", other, camera)


@pytest.mark.parametrize("objects_per_image", [(1, 1), (1, 2)])
def test_other_subjects_are_drawn_at_the_fields_draws_backgrounds_and_places(objects_per_image):
    """The same generator. Straight alpha and back costs some float32 rounding."""
    plain = scene(objects_per_image)
    shown = tuple(PhotographedField(each.name, each.field) for each in plain.fields)
    one, other = (
        each.training_set(PSI, 5, torch.Generator().manual_seed(3))
        for each in (plain, dataclasses.replace(plain, subjects=shown))
    )
    torch.testing.assert_close(other.images.images, one.images.images, rtol=0.0, atol=1e-5)
    assert torch.equal(other.images.labels, one.images.labels)
    assert torch.equal(other.images.boxes, one.images.boxes)
    assert torch.equal(other.images.bins, one.images.bins)


def test_a_subject_is_seen_from_the_poses_of_the_draw():
    flat = flats()
    made = scene(subjects=flat).training_set(PSI, 3, torch.Generator().manual_seed(0))
    for label, subject in enumerate(flat):
        draw = made.objects[label].draw
        assert torch.equal(torch.cat(subject.poses), orbit(draw.phi, draw.rho, draw.distance))
        x0, y0, x1, y1 = made.images.boxes[3 * label, 0].int().tolist()
        inside = made.images.images[3 * label, :, y0:y1, x0:x1]
        assert torch.equal(inside, torch.tensor(subject.colour)[:, None, None].expand_as(inside))


def test_what_a_subject_has_not_is_refused_by_its_name():
    for subjects in (flats(), pictures()):
        with pytest.raises(ValueError, match="a: want hard draws"):
            scene(subjects=subjects).draw(0, PSI[0], 2, torch.Generator(), RelaxedDraws())
        with pytest.raises(ValueError, match=r"want fields, got other subjects for \['a', 'b'\]"):
            _ = scene(subjects=subjects).fields
    with pytest.raises(ValueError, match="b: pictures are not drawn by bins"):
        scene(subjects=pictures()).probes(1, "pose", 2, PSI, torch.Generator())
    with pytest.raises(ValueError, match="a: its mesh has one fixed light"):
        MeshSubject("a", None, None).maps(CAMERA, torch.eye(4)[None], torch.ones(1, 3))
    metres = SceneDistribution.of([Pose(bins=4)], Unlearned(distance=(0.5, 0.7), distance_unit="metres"))
    with pytest.raises(ValueError, match="nothing gives the size of a, b"):
        dataclasses.replace(scene(), distribution=metres)


def test_an_object_that_shows_in_no_image_is_rendered_in_none():
    for label in range(2):
        part = scene().draw(label, PSI[label], 0, torch.Generator())
        assert len(part) == 0 and part.rgb.shape == (0, 24, 24, 3)


def test_a_mesh_that_shows_in_no_image_may_have_lights():
    """As in a target set of few images, some of which are empty."""
    subject = MeshSubject("mug", Procedural(["mug"]).load()[0].mesh, RaycastRenderer(1), LightRig(3))
    maps = subject.maps(CAMERA, torch.zeros(0, 4, 4), torch.zeros(0, 3))
    assert maps.rgb.shape == (0, 24, 24, 3)
    with pytest.raises(ValueError, match="mug: want the same weights of lights for all images"):
        subject.maps(CAMERA, torch.eye(4).expand(2, 4, 4), torch.eye(3)[:2])


@pytest.mark.parametrize("objects_per_image", [(1, 1), (1, 2)])
def test_training_images_show_the_pictures_whatever_psi_is(objects_per_image):
    shown = scene(objects_per_image, pictures())
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
    part = scene(subjects=pictures()).draw(1, torch.zeros(4), 5, torch.Generator())
    middle = part.rgb[:, 9:15, 9:15]
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.75, 0.0]).expand_as(middle))
    torch.testing.assert_close(part.opacity[:, 12, 12], torch.full((5,), 0.75))
    assert not part.opacity[:, :4].any() and not part.opacity[:, :, 20:].any()


def test_a_draw_says_from_where_the_picture_was_taken():
    shown = scene(subjects=pictures(other=views((0.0, 1.0, 0.0), (0.7,), 2.5)))
    draw = shown.draw(1, torch.zeros(4), 2, torch.Generator()).draw
    torch.testing.assert_close(draw.phi, torch.full((2,), 0.7))
    torch.testing.assert_close(draw.rho, torch.full((2,), -1.0))
    torch.testing.assert_close(draw.distance, torch.full((2,), 2.5))


def test_a_picture_much_longer_than_wide_keeps_a_pixel_of_width():
    thin = PosedViews(torch.ones(1, 1, 100, 4), torch.eye(4)[None], PinholeCamera(100, 1, 0.1))
    thin = dataclasses.replace(thin, camera_to_world=orbit(*torch.tensor([[0.3], [1.0], [3.0]])))
    opacity = PictureSubject.of("a", thin, CAMERA).pictures[0, ..., 3]
    assert (opacity > 0.5).sum(0).tolist() == [1] * 24


def test_pictures_fit_into_wide_images_without_being_stretched():
    opacity = pictures(camera=PinholeCamera(36, 24, math.radians(40.0)))[0].pictures[0, ..., 3]
    assert opacity.shape == (24, 36)
    inside = (opacity > 0.4).nonzero()
    assert inside.amin(0).tolist() == [6, 12] and inside.amax(0).tolist() == [17, 23]

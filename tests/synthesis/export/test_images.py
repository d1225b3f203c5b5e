"""Exported images: drawn by number, rendered on a part of the plane, composed; masks and depth against ray casting."""

import dataclasses

import numpy as np
import pytest
import torch
from posed_scenes import directions, z_buffer

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.synthesis.compositing import by_depth, stacked
from neural_sim.synthesis.export.images import ImageSource, reach_on_image

STEP, DEEP = 0.125 * 0.05, np.log(2.0) * 0.125 / 40.0  # conftest.py


def matrix(camera) -> np.ndarray:
    fy = 0.5 * camera.height / np.tan(0.5 * camera.field_of_view)
    x, y = camera.centre or (0.5 * camera.width, 0.5 * camera.height)
    return np.array([[camera.aspect * fy, 0.0, x - 0.5], [0.0, fy, y - 0.5], [0.0, 0.0, 1.0]])


def interior(mask: np.ndarray) -> np.ndarray:
    """Pixels whose eight neighbours are in the mask, too."""
    whole = np.pad(mask, 1)
    rows, columns = mask.shape
    return np.all([whole[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)


@pytest.mark.parametrize("number", range(4))
def test_masks_and_depth_are_those_of_the_boxes_at_the_poses(boxes, number):
    """By casting rays at the meshes, at poses and a camera matrix alone."""
    made = boxes(count=(3, 3))
    image = made.source.image(number)
    order = sorted(
        image.objects, key=lambda o: float(o.placed.draw.distance) * made.source.millimetres[o.placed.label]
    )
    rays = directions(matrix(image.objects[0].placed.camera), (64, 48))
    hidden = np.zeros((48, 64), bool)
    for item in order:
        model, name = made.models[item.placed.label], made.models[item.placed.label].name
        pose = model.pose(item.placed.camera_to_world.tolist())
        _, depth, (silhouette,) = z_buffer([model.mesh], [pose], rays)
        # Cells end at faces; rays that graze an edge may find too little of it.
        border = silhouette ^ interior(silhouette) | ~silhouette ^ interior(~silhouette)
        assert not (item.full ^ silhouette)[~border].any(), name
        assert np.array_equal(item.visible[~border], (silhouette & ~hidden)[~border])
        inner = interior(silhouette) & item.visible & ~border
        # The first sample in the box is up to a step behind its face, and stands for half a step to each side. Depth
        # is along the axis, which is less than along the ray.
        error = np.abs(image.depth - depth)[inner]
        assert len(error) == 0 or error.max() <= 1.05 * model.millimetres * (0.5 * STEP + DEEP)
        hidden |= item.full
    assert np.array_equal(image.depth > 0.0, np.any([item.visible for item in image.objects], axis=0))


def test_an_image_is_what_full_frames_of_its_layers_compose(boxes):
    """Objects are rendered on a part of the plane alone; :func:`stacked` composes whole frames."""
    source = boxes(count=(3, 3)).source
    for number in range(3):
        placed = source.drawn(number)
        frames = [
            source.scene.fields[item.label].maps(item.camera, item.camera_to_world[None]) for item in placed
        ]
        distance = torch.tensor([[float(o.draw.distance) * source.millimetres[o.label] for o in placed]])
        order = by_depth(distance, torch.tensor([[item.order for item in placed]]))[0]
        nearest = [frames[i] for i in order.tolist()]
        rgb = torch.stack([maps.rgb[0] for maps in nearest])[None]
        opacity = torch.stack([maps.opacity[0] for maps in nearest])[None]
        background = source.scene.synthesizer.background.draw(1, 48, 64, source.generator(number, "pixels"))
        wanted, visible = stacked(rgb, opacity, background)
        image = source.image(number)
        pixels = torch.from_numpy(image.pixels).movedim(-1, 0) / 255
        assert float((pixels - wanted[0]).abs().max()) <= 0.5 / 255 + 1e-4  # float32 along rays
        for place, index in enumerate(order.tolist()):
            apart = (visible[0, place] - 0.5).abs() > 1e-3
            assert np.array_equal(
                image.objects[index].visible[apart], (visible[0, place] > 0.5)[apart].numpy()
            )


def test_an_image_depends_on_seed_and_number_alone(boxes):
    """Not on which were made before, nor on the size of the set; scenes do not depend on the image's size."""
    source, again, other = boxes().source, boxes().source, boxes(seed=4).source
    last = [source.image(number) for number in (0, 1, 2)][-1]
    assert np.array_equal(last.pixels, again.image(2).pixels) and np.array_equal(
        last.depth, again.image(2).depth
    )
    assert not np.array_equal(last.pixels, other.image(2).pixels)
    large = dataclasses.replace(source, camera=dataclasses.replace(source.camera, width=128, height=96))
    for small, big in zip(source.drawn(5), large.drawn(5), strict=True):
        assert (small.label, small.order, small.draw.phi) == (big.label, big.order, big.draw.phi)
        fractions = [np.array(item.shift) / (item.camera.width, item.camera.height) for item in (small, big)]
        assert np.abs(fractions[0] - fractions[1]).max() <= 1.0 / 48


def test_every_class_has_equally_many_images_of_its_own_and_draws_follow_psi(boxes):
    source = boxes(count=(1, 2)).source
    psi = torch.full_like(source.psi, -30.0)
    psi[:, 2] = 0.0
    source = dataclasses.replace(source, psi=psi)
    drawn = [source.drawn(number) for number in range(60)]
    assert [objects[0].label for objects in drawn] == [number % 3 for number in range(60)]
    assert {len(objects) for objects in drawn} == {1, 2}
    bins = np.array([int(item.draw.bins[0, 0]) for objects in drawn for item in objects])
    # A bin's floor is 0.005: of n draws, others than the third have a mean of 0.035 n.
    assert (bins != 2).sum() <= 0.035 * len(bins) + 5 * np.sqrt(0.035 * len(bins))


def test_a_shift_turns_the_camera_and_leaves_the_viewpoint(boxes):
    source = boxes(count=(1, 1)).source
    for number in range(6):
        (item,) = source.drawn(number)
        at = (
            -item.camera_to_world[:3, :3].T @ item.camera_to_world[:3, 3]
        )  # the object's centre, seen by the camera
        pixel = matrix(item.camera) @ np.array([at[0], -at[1], -at[2]])
        assert pixel[:2] / pixel[2] == pytest.approx((31.5 + item.shift[0], 23.5 + item.shift[1]), abs=1e-9)
        assert float(at.norm()) == pytest.approx(float(item.draw.distance), rel=1e-12)


def test_pixels_beyond_the_image_count_for_the_whole(boxes):
    source = boxes(count=(1, 1), shift=0.9).source
    cut = [
        item for number in range(12) for item in source.image(number).objects if item.pixels > item.full.sum()
    ]
    assert cut
    wide = dataclasses.replace(
        source,
        camera=dataclasses.replace(source.camera, width=192, height=144,
                                   field_of_view=2 * np.arctan(3 * np.tan(np.radians(20.0)))),
    )  # fmt: skip
    for item in cut:
        pose = item.placed
        seen = wide.scene.fields[pose.label].maps(wide.camera, pose.camera_to_world[None]).opacity[0]
        mask = (seen > 0.5).numpy()
        assert item.pixels == mask.sum()
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        assert item.box == (columns[0] - 64, rows[0] - 48, columns[-1] + 1 - 64, rows[-1] + 1 - 48)


def test_too_little_of_an_object_is_no_label(boxes):
    source = boxes(count=(3, 3)).source
    strict = dataclasses.replace(
        source,
        scene=dataclasses.replace(
            source.scene, synthesizer=dataclasses.replace(source.scene.synthesizer, min_visibility=0.9)
        ),
    )
    objects = [item for number in range(8) for item in strict.image(number).objects]
    for item in objects:
        enough = item.visible.sum() >= max(4, 0.9 * item.full.sum())
        assert item.labelled == bool(enough)
    assert {item.labelled for item in objects} == {True, False}


def test_a_longer_focal_length_is_the_images_own(boxes):
    zoom = SceneDistribution.of([Pose(), Zoom(by="focal_length", range=(0.5, 2.0))])
    source = boxes(count=(1, 1), distribution=zoom).source
    for number in range(3):
        (item,) = source.drawn(number)
        wanted = 24.0 / np.tan(np.radians(20.0)) * float(item.draw.magnification)
        assert matrix(item.camera)[1, 1] == pytest.approx(wanted)
    assert isinstance(source, ImageSource)


def test_the_reach_of_a_ball_holds_its_image(boxes):
    source = boxes(count=(1, 1), shift=0.9).source
    for number in range(10):
        (item,) = source.drawn(number)
        x0, y0, x1, y1 = reach_on_image(item.camera, item.camera_to_world, 1.0)
        points = torch.randn(4000, 3, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
        points = points / points.norm(dim=1, keepdim=True)
        seen = (points - item.camera_to_world[:3, 3]) @ item.camera_to_world[:3, :3]
        pixels = seen.numpy() * [1.0, -1.0, -1.0] @ matrix(item.camera).T
        pixels = pixels[:, :2] / pixels[:, 2:] + 0.5
        canvas = (np.array([-64, -48]), np.array([128, 96]))
        pixels = pixels[((pixels > canvas[0]) & (pixels < canvas[1])).all(1)]
        assert (pixels >= (x0, y0)).all() and (pixels <= (x1, y1)).all()
        # And not much more: within a pixel of its rounding and the random points' own gaps.
        inside = [x0 > -64, y0 > -48, x1 < 128, y1 < 96]
        gaps = [*(pixels.min(0) - (x0, y0)), *((x1, y1) - pixels.max(0))]
        assert all(gap < 4.0 for gap, free in zip(gaps, inside, strict=True) if free and len(pixels) > 3000)

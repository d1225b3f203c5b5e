"""Anchor lights and the lights of training views."""

import math

import numpy as np
import pytest
import torch
import trimesh

from neural_sim.cameras import orbit
from neural_sim.objects.mesh import normalise
from neural_sim.renderer.lighting import lambert
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig, VariedLight
from neural_sim.renderer.views import render_views
from neural_sim.types import PinholeCamera


@pytest.mark.parametrize("count", [2, 3, 6, 11])
def test_anchors_differ_in_direction_temperature_and_intensity(count):
    rig = LightRig(anchors=count)
    lights = rig.lights()
    directions = np.array([light.direction for light in lights])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    closest = (directions @ directions.T - 2.0 * np.eye(count)).max()
    assert closest < math.cos(0.5 * math.sqrt(4.0 * math.pi / count))  # at least half the even spacing apart
    assert len({light.colour for light in lights}) == len({light.intensity for light in lights}) == count
    assert sorted(light.intensity for light in lights)[:: count - 1] == pytest.approx(
        list(rig.intensity_range)
    )


def test_weights_mix_the_anchors_linearly():
    rig, generator = LightRig(), np.random.default_rng(1)
    normals = generator.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    alone = np.stack([lambert(normals, rig.lighting(row)) for row in torch.eye(6)])
    weights = torch.tensor([0.3, 0.1, 0.25, 0.05, 0.2, 0.1])
    mixed = lambert(normals, rig.lighting(weights))
    np.testing.assert_allclose(mixed, np.tensordot(weights.numpy(), alone, 1), atol=1e-7)
    affine = lambert(normals, rig.lighting([1.3, -0.3, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(affine, np.maximum(1.3 * alone[0] - 0.3 * alone[1], 0.0), atol=1e-12)


@pytest.mark.parametrize(("count", "anchored"), [(84, 0.5), (20, 0.5), (24, 1.0), (50, 0.3)])
def test_every_anchor_lights_its_share_of_the_views(generator, count, anchored):
    weights = VariedLight(anchored=anchored, mixtures=5).weights(count, generator)
    torch.testing.assert_close(weights.sum(1), torch.ones(count))
    pure = weights.amax(1) == 1.0
    assert int(pure.sum()) == math.floor(count * anchored)
    seen = weights[pure].sum(0)
    assert seen.max() - seen.min() <= 1 and seen.min() >= 1
    assert len(weights[~pure].unique(dim=0)) == min(5, int((~pure).sum()))


def test_views_under_a_rig_are_those_of_each_light(generator):
    box = trimesh.creation.box((1.0, 0.7, 0.4))
    box.visual = trimesh.visual.ColorVisuals(box, face_colors=np.tile([200, 120, 60, 255], (12, 1)))
    item, camera = normalise(box, "box", "test"), PinholeCamera(16, 16, math.radians(40.0))
    angles = torch.rand((3, 6), generator=generator)
    poses, rig = orbit(6.0 * angles[0], angles[1], 2.5 + angles[2]), LightRig(anchors=3)
    weights = torch.eye(3)[[0, 2, 1, 0, 2, 2]]
    renderer = RaycastRenderer(1)
    views = render_views(renderer, item, camera, poses, rig, weights)
    assert views.light_weights is weights
    for i in range(6):
        alone = renderer.render(item.mesh, camera, poses[i : i + 1], rig.lighting(weights[i]))
        assert torch.equal(views.images[i : i + 1], alone)
    assert not torch.equal(views.images[:1], renderer.render(item.mesh, camera, poses[:1]))
    chosen = views.select(torch.tensor([1, 4])).light_weights
    assert chosen is not None and torch.equal(chosen, weights[[1, 4]])


def test_weights_that_do_not_fit_the_anchors_are_refused(generator):
    with pytest.raises(ValueError, match="6 weights"):
        LightRig().lighting([1.0])
    with pytest.raises(ValueError, match="all 6 anchors"):
        VariedLight(anchored=0.2).weights(20, generator)

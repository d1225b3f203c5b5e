"""Settings of the stages: what they mean, beyond what they refuse."""

import torch
import trimesh

from neural_sim.objects.mesh import normalise
from neural_sim.renderer.rig import VariedLight
from neural_sim.renderer.views import Views


class Nothing:
    """A renderer of empty images."""

    def render(self, mesh, camera, camera_to_world, lighting=None):
        return torch.zeros(len(camera_to_world), camera.height, camera.width, 4)


def test_views_held_out_follow_those_that_train():
    item = normalise(trimesh.creation.box(), "box", "test")
    made = Views(count=14, held_out=3, image_size=4, lights=VariedLight()).render(Nothing(), item)
    assert len(made) == 17 and made.light_weights is not None
    # How many there are in all decides poses and lights, not how many of them are held out.
    other = Views(count=17, held_out=0, image_size=4, lights=VariedLight()).render(Nothing(), item)
    assert torch.equal(made.camera_to_world, other.camera_to_world)
    assert other.light_weights is not None and torch.equal(made.light_weights, other.light_weights)
    distance = made.camera_to_world[:, :3, 3].norm(dim=-1)
    assert distance.min() >= 2.4 and distance.max() <= 4.0

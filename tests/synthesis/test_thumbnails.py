"""Pictures of bins."""

import math

import torch

from neural_sim.cameras import orbit
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.thumbnails import bin_thumbnails
from neural_sim.types import Maps, PinholeCamera


class Seen(RenderedSubject):
    """Half opaque red; remembers its poses."""

    def maps(self, camera, camera_to_world, weights=None):
        self.__dict__["poses"] = camera_to_world
        shape = (len(camera_to_world), camera.height, camera.width)
        return Maps(torch.tensor([0.5, 0.0, 0.0]).expand(*shape, 3), torch.full(shape, 0.5))


def test_every_bin_is_seen_from_its_middle_over_white():
    item, camera = Seen("a"), PinholeCamera(4, 4, math.radians(40.0))
    distribution = SceneDistribution.of([Pose(bins=4), Zoom()])
    images = bin_thumbnails(item, distribution, "pose", camera)
    assert images.shape == (4, 4, 4, 3)
    torch.testing.assert_close(images[0, 0, 0], torch.tensor([1.0, 0.5, 0.5]))
    phi = torch.tensor([45.0, 135.0, 225.0, 315.0]).deg2rad()
    toward = orbit(phi, torch.zeros(4), torch.ones(4))[:, :3, 3]
    away = item.poses[:, :3, 3]
    torch.testing.assert_close(away / away.norm(dim=1, keepdim=True), toward, atol=1e-6, rtol=0.0)
    zoom = next(f for f in distribution.binned if f.name == "zoom")
    bin_thumbnails(item, distribution, "zoom", camera)
    distances = item.poses[:, :3, 3].norm(dim=1)
    assert zoom.bin_of(distances).tolist() == list(range(zoom.bins))

"""How psi moves the cameras, against central differences."""

from dataclasses import replace

import pytest
import torch

from neural_sim import cameras
from neural_sim.cameras import pixel_rays, ray_rates
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.motion import RIGID, moved_by, pose_rates
from neural_sim.types import PinholeCamera, SceneDraw

DRAW = SceneDraw(*torch.rand(3, 4, dtype=torch.float64) + 1.5, torch.zeros(4, 1, dtype=torch.long))


def test_pose_rates_are_the_derivatives_of_the_orbit() -> None:
    numbers = {name: getattr(DRAW, name) for name in RIGID}
    for name, rate in zip(RIGID, pose_rates(DRAW, RIGID), strict=True):
        ends = [cameras.orbit(**{**numbers, name: numbers[name] + step}) for step in (1e-6, -1e-6)]
        torch.testing.assert_close(rate, (ends[0] - ends[1]) / 2e-6, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("axis", "name"), [("polar", "phi"), ("azimuth", "rho")])
def test_psi_moves_the_binned_angle_alone(axis: str, name: str, generator: torch.Generator) -> None:
    pose = SceneDistribution.of([Pose(axis=axis)])
    noise = pose.draw_noise(3, generator)
    assert moved_by(lambda psi: pose.relaxed(psi, noise), torch.zeros(8)) == (name,)
    assert moved_by(lambda psi: pose.hard(psi, noise), torch.zeros(8)) == ()


def test_rays_follow_the_focal_length() -> None:
    """The rays' rates, unit length kept, against central differences of the magnified cameras' rays."""
    camera, size = PinholeCamera(5, 4, 1.2), 1.7
    poses, pixel = cameras.orbit(DRAW.phi, DRAW.rho, DRAW.distance)[:1], torch.arange(20)
    drawn = replace(DRAW.select(torch.tensor([0])), magnification=torch.tensor([size], dtype=torch.float64))
    at, *ends = (cameras.magnified(camera, size + step) for step in (0.0, 1e-6, -1e-6))
    moved = ray_rates(at, pixel_rays(at, poses, pixel), pose_rates(drawn, ("magnification",)), pixel)
    ahead, behind = (pixel_rays(camera, poses, pixel).directions for camera in ends)
    torch.testing.assert_close(moved.directions[0], (ahead - behind) / 2e-6, rtol=0.0, atol=1e-8)
    assert float(moved.directions.abs().max()) > 0.1 and not moved.origins.any()


@pytest.mark.parametrize("names", [(), ("bins",), ("phi", "tilt"), ("magnification",)])
def test_other_names_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="names of the draw"):
        pose_rates(DRAW, names)

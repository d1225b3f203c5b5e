"""How psi moves the cameras, against central differences."""

import pytest
import torch

from neural_sim import cameras
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.motion import RIGID, moved_by, pose_rates
from neural_sim.types import SceneDraw

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


@pytest.mark.parametrize("names", [(), ("bins",), ("phi", "tilt")])
def test_other_names_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="names among"):
        pose_rates(DRAW, names)

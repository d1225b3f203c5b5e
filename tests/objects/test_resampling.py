"""Views from photographs that show a part of the object from nearby, in views that show all of it."""

import math

import pytest
import torch

from neural_sim.cameras import focal_length
from neural_sim.objects import resampling
from neural_sim.objects.capture import Frame, Lens
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(40, 40, math.radians(120.0))


def of_a_photograph(pose, size=(120, 80), focal=100.0, **lens):
    """Return the view, which of its pixels are known, and the number of samples it was made from."""
    width, height = size
    frame = Frame("", pose.numpy(), Lens(width, height, focal, focal, width / 2, height / 2, **lens))
    photo = torch.rand(height, width, 4, generator=torch.Generator().manual_seed(0))
    turned = torch.from_numpy(resampling.turned_to_origin(pose.numpy()))
    return resampling._view(photo, frame, pose, turned, CAMERA)


def looking(aside, distance=1.2):
    """A camera above the origin that looks ``aside`` of it, in radians."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor(
        [[math.cos(aside), 0.0, math.sin(aside)], [0.0, 1.0, 0.0], [-math.sin(aside), 0.0, math.cos(aside)]]
    )
    pose[2, 3] = distance
    return pose


@pytest.mark.parametrize("aside", [0.0, 0.3, -0.7])
@pytest.mark.parametrize("lens", [{}, {"radial": (0.2,)}])
def test_only_the_part_with_the_photograph_is_sampled_and_it_is_the_same(aside, lens, monkeypatch):
    view, known = of_a_photograph(looking(aside), **lens)
    monkeypatch.setattr(resampling, "_window", lambda *_: (0, CAMERA.height, 0, CAMERA.width))
    whole, all_known = of_a_photograph(looking(aside), **lens)
    assert torch.equal(view, whole) and torch.equal(known, all_known)
    wide = (
        120 / 100.0 * focal_length(CAMERA)
    )  # the photograph's width in pixels of a view that looks the same way
    if aside == 0.0 and not lens:
        assert known.any(0).sum() == pytest.approx(wide, abs=2)


def test_a_photograph_that_looks_elsewhere_shows_nothing():
    view, known = of_a_photograph(looking(2.5))
    assert not known.any() and not view.any()


def test_the_window_is_as_small_as_the_photograph():
    pose = looking(0.0)
    frame = Frame("", pose.numpy(), Lens(120, 80, 100.0, 100.0, 60.0, 40.0))
    top, bottom, left, right = resampling._window(frame, pose, pose, CAMERA)
    side = focal_length(CAMERA) / 100.0
    assert right - left == pytest.approx(120 * side + 2, abs=2) and bottom - top == pytest.approx(
        80 * side + 2, abs=2
    )
    assert (top + bottom, left + right) == (40, 40)

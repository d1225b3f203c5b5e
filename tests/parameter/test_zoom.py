"""Zoom's bins: of equal ratio, without a wrap, and how much larger objects look from one to the next."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.objects.procedural import Procedural
from neural_sim.parameter.bins import BinNoise
from neural_sim.parameter.zoom import Zoom
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.types import PinholeCamera


def test_bins_have_equal_ratios_and_hold_their_draws(generator):
    (zoom,) = Zoom(bins=4, range=(2.0, 8.0)).factors
    bins = torch.arange(4).repeat_interleave(500)
    drawn = zoom.at(bins, torch.rand(2000, generator=generator, dtype=torch.float64))
    edges = 2.0 * 4.0 ** (torch.arange(5, dtype=torch.float64) / 4)
    assert (drawn >= edges[bins] - 1e-12).all() and (drawn <= edges[bins + 1] + 1e-12).all()
    assert torch.equal(zoom.bin_of(drawn), bins)


def test_what_lies_outside_belongs_to_the_bin_at_that_end():
    (zoom,) = Zoom(range=(2.0, 8.0)).factors
    assert zoom.bin_of(torch.tensor([1.5, 2.0, 8.0, 20.0])).tolist() == [0, 0, 3, 3]


def test_objects_look_at_least_1_4_times_larger_from_bin_to_bin():
    """The default's neighbouring bins, at their middles, by the height of a rendered mug beyond the near field."""
    (zoom,) = Zoom().factors
    middle = zoom.at(torch.arange(4), torch.full((4,), 0.5, dtype=torch.float64))
    assert (middle[1:] / middle[:-1]).min() >= 1.4
    (item,) = Procedural(["mug"]).load()
    side = torch.full((4,), math.pi / 2)
    pose = cameras.orbit(side, torch.zeros(4), middle.float())
    alpha = RaycastRenderer(1).render(item.mesh, PinholeCamera(256, 256, math.radians(60.0)), pose)[..., 3]
    heights = (alpha > 0.5).any(2).sum(1).float()
    assert (heights[:-1] / heights[1:]).min() >= 1.4 * (1 - 2 / heights[-1])  # a pixel at either end


def test_the_relaxed_distance_against_central_differences(generator):
    (zoom,) = Zoom(temperature=0.7).factors
    psi = torch.randn(4, generator=generator, dtype=torch.float64, requires_grad=True)
    noise = BinNoise(torch.randn(5, 4, generator=generator, dtype=torch.float64))
    within = torch.rand(5, generator=generator, dtype=torch.float64)
    value, _ = zoom.relaxed(psi, noise, within)
    (slope,) = torch.autograd.grad(value.log().sum(), psi)
    expected = []
    for e in torch.eye(4, dtype=torch.float64) * 1e-6:
        up, down = (zoom.relaxed(psi.detach() + s * e, noise, within)[0].log().sum() for s in (1, -1))
        expected.append(float(up - down) / 2e-6)
    assert slope.tolist() == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (
            {"range": (1.0, 4.0)},
            r"parameter\.zoom\.range: want more than 1\.05 object radii, got \[1\.0, 4\.0\]",
        ),
        ({"floor": 0.3}, r"parameter\.zoom\.floor: want less than 1/4"),
        ({"biased": {"mug": {"target": {"dominant": 9}}}}, r"parameter\.zoom\.target of mug"),
    ],
)
def test_bad_settings_name_their_key(bad, message):
    with pytest.raises(ValueError, match=message):
        Zoom(**bad)

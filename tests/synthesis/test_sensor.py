"""Blur against an independent convolution, noise against its deviation."""

import math

import pytest
import torch
from scipy import ndimage

from neural_sim.synthesis.sensor import Sensor, SensorDraw, blurred, seen_by


def test_every_image_is_blurred_by_its_own_gaussian():
    images = torch.rand(3, 2, 17, 21, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    deviation = torch.tensor([0.0, 0.7, 1.6], dtype=torch.float64)
    found = blurred(images, deviation)
    torch.testing.assert_close(found[0], images[0], rtol=0.0, atol=1e-12)
    for row, channel in ((1, 0), (1, 1), (2, 0), (2, 1)):
        width = float(deviation[row])
        reach = math.ceil(3.0 * width)
        truth = ndimage.gaussian_filter(images[row, channel].numpy(), width, mode="nearest", radius=reach)
        torch.testing.assert_close(found[row, channel], torch.from_numpy(truth), rtol=0.0, atol=1e-12)


def test_the_blur_of_an_image_does_not_depend_on_the_others():
    images = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    both, one = blurred(images, torch.tensor([1.0, 4.0])), blurred(images[:1], torch.tensor([1.0]))
    torch.testing.assert_close(both[:1], one, rtol=0.0, atol=1e-12)


def test_noise_has_the_deviation_that_was_drawn():
    sensor = Sensor(noise=[0.05, 0.05])
    drawn = sensor.draw(4, 64, 64, torch.Generator().manual_seed(0))
    assert drawn is not None and drawn.blur is None
    noisy = seen_by(torch.full((4, 3, 64, 64), 0.5), drawn)
    assert float((noisy - 0.5).std()) == pytest.approx(0.05, rel=0.02)
    assert float(seen_by(torch.ones(4, 3, 64, 64), drawn).max()) == 1.0


def test_without_either_nothing_is_drawn():
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    assert Sensor().draw(4, 8, 8, generator) is None and torch.equal(generator.get_state(), before)
    images = torch.rand(2, 3, 4, 4)
    assert seen_by(images, None) is images


def test_a_selection_keeps_its_own_blur_and_noise():
    drawn = Sensor(blur=[0.1, 2.0], noise=[0.0, 0.1]).draw(5, 6, 7, torch.Generator().manual_seed(0))
    assert drawn is not None
    images, rows = torch.rand(5, 3, 6, 7), torch.tensor([3, 1])
    torch.testing.assert_close(
        seen_by(images[rows], drawn.select(rows)), seen_by(images, drawn)[rows], atol=1e-6, rtol=0
    )
    assert isinstance(drawn.select(rows), SensorDraw)

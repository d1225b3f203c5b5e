"""The quadrature on packed samples, against closed forms and a per-ray loop."""

import math

import pytest
import torch

from neural_sim.field.quadrature import PackedSamples, alpha_from_sigma, composite, sum_rays, transmittance


def pack(counts: list[int], width: float = 0.1) -> PackedSamples:
    number = torch.tensor(counts)
    starts = torch.nn.functional.pad(number.cumsum(0), (1, 0))
    total = int(starts[-1])
    ray = torch.repeat_interleave(torch.arange(len(counts)), number)
    distance = torch.arange(total, dtype=torch.float64)
    return PackedSamples(ray, distance, torch.full((total,), width, dtype=torch.float64), starts)


def test_a_homogeneous_medium_absorbs_by_beer_and_lambert() -> None:
    samples = pack([10])
    sigma, rgb = torch.full((10,), 2.5, dtype=torch.float64), torch.full((10, 3), 0.4, dtype=torch.float64)
    colour, opacity = composite(sigma, rgb, samples)
    expected = 1.0 - math.exp(-2.5 * 10 * 0.1)
    assert opacity[0].item() == pytest.approx(expected, abs=1e-14)
    assert colour[0].tolist() == pytest.approx([0.4 * expected] * 3, abs=1e-14)


def test_packed_rays_equal_a_loop_over_each_ray(generator: torch.Generator) -> None:
    counts = [0, 5, 1, 0, 7, 0]
    samples = pack(counts, 0.3)
    sigma = torch.rand(13, generator=generator, dtype=torch.float64) * 8.0
    rgb = torch.rand(13, 3, generator=generator, dtype=torch.float64)
    colour, opacity = composite(sigma, rgb, samples)
    place = 0
    for ray, count in enumerate(counts):
        light, seen = 1.0, torch.zeros(3, dtype=torch.float64)
        for index in range(place, place + count):
            alpha = 1.0 - math.exp(-float(sigma[index]) * 0.3)
            seen, light = seen + light * alpha * rgb[index], light * (1.0 - alpha)
        place += count
        torch.testing.assert_close(colour[ray], seen, atol=1e-12, rtol=0.0)
        assert opacity[ray].item() == pytest.approx(1.0 - light, abs=1e-12)


def test_tiny_optical_depth_is_not_rounded_away() -> None:
    alpha = alpha_from_sigma(torch.tensor([1e-9]), torch.tensor([1.0]))
    assert alpha.item() == pytest.approx(1e-9, rel=1e-6)


def test_transmittance_starts_at_one_on_every_ray(generator: torch.Generator) -> None:
    samples = pack([3, 0, 4])
    light = transmittance(torch.rand(7, generator=generator, dtype=torch.float64), samples)
    assert light[[0, 3]].tolist() == [1.0, 1.0]
    assert bool((light.diff()[[0, 1, 3, 4, 5]] < 0).all())


def test_derivatives_equal_central_differences(generator: torch.Generator) -> None:
    samples = pack([4, 0, 3])
    sigma = torch.rand(7, generator=generator, dtype=torch.float64).requires_grad_()
    rgb = torch.rand(7, 3, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda s, c: composite(s, c, samples), (sigma, rgb), check_forward_ad=True
    )
    assert torch.autograd.gradgradcheck(lambda s: composite(s, rgb.detach(), samples), (sigma,))


def test_sum_of_no_samples_is_zero() -> None:
    samples = pack([0, 0])
    assert sum_rays(torch.zeros(0, 2, dtype=torch.float64), samples).tolist() == [[0.0, 0.0], [0.0, 0.0]]
    colour, opacity = composite(torch.zeros(0), torch.zeros(0, 3), samples)
    assert colour.shape == (2, 3) and opacity.tolist() == [0.0, 0.0]

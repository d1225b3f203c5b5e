import logging

import pytest
import torch
from torch import Tensor

from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.synthesizer import Nuisance, Synthesizer, images_without_boxes
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(10, 8, 0.7)


@pytest.fixture
def synthesizer() -> Synthesizer:
    return Synthesizer(ProceduralClutter(shapes=2), shift=0.3, minimum_area=1)


def maps(n: int = 3, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(5)
    opacity = 0.05 + 0.9 * torch.rand((n, CAMERA.height, CAMERA.width), generator=generator, dtype=dtype)
    return opacity[..., None] * torch.rand((*opacity.shape, 3), generator=generator, dtype=dtype), opacity


def test_derivatives_agree_with_central_differences(synthesizer: Synthesizer) -> None:
    rgb, opacity = maps()
    nuisance = synthesizer.draw_nuisance(3, CAMERA, torch.Generator().manual_seed(1))
    assert nuisance.shifts.any()
    bins = torch.zeros(3, dtype=torch.long)

    def energy(rgb: Tensor, opacity: Tensor) -> Tensor:
        images = synthesizer.compose(rgb, opacity, nuisance, 0, bins).images
        return (images**3).sum()

    leaves = rgb.clone().requires_grad_(), opacity.clone().requires_grad_()
    exact = torch.autograd.grad(energy(*leaves), leaves)
    step = 1e-5
    generator = torch.Generator().manual_seed(2)
    for which, value in enumerate((rgb, opacity)):
        for _ in range(4):
            direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
            ends = []
            for sign in (1, -1):
                inputs = [rgb, opacity]
                inputs[which] = value + sign * step * direction
                ends.append(energy(*inputs))
            numeric = (ends[0] - ends[1]) / (2 * step)
            torch.testing.assert_close((exact[which] * direction).sum(), numeric, rtol=1e-8, atol=1e-9)


def test_composing_is_pure_and_labels_carry_no_gradient(synthesizer: Synthesizer) -> None:
    rgb, opacity = (value.requires_grad_() for value in maps())
    nuisance = synthesizer.draw_nuisance(3, CAMERA, torch.Generator().manual_seed(1))
    bins = torch.tensor([4, 5, 6])
    first = synthesizer.compose(rgb, opacity, nuisance, 2, bins)
    second = synthesizer.compose(rgb, opacity, nuisance, 2, bins)
    assert torch.equal(first.images, second.images)
    assert torch.equal(first.boxes, second.boxes)
    assert first.images.requires_grad
    assert not first.boxes.requires_grad
    assert first.images.dtype == first.boxes.dtype == torch.float64
    assert first.labels.tolist() == [[2]] * 3
    assert first.bins.tolist() == [4, 5, 6]


def test_the_box_goes_with_the_shift_and_is_clipped() -> None:
    opacity = torch.zeros(4, 8, 10)
    opacity[:, 2:5, 3:7] = 1.0
    shifts = torch.tensor([[0, 0], [2, -1], [-5, 5], [7, 0]])
    nuisance = Nuisance(torch.zeros(4, 3, 8, 10), shifts)
    made = Synthesizer(ProceduralClutter(), 0.0, minimum_area=1).compose(
        opacity[..., None].expand(-1, -1, -1, 3), opacity, nuisance, 1, torch.arange(4)
    )
    assert made.boxes[:, 0].tolist() == [[3, 2, 7, 5], [5, 1, 9, 4], [0, 7, 2, 8], [0, 0, 0, 0]]
    assert made.labels[:, 0].tolist() == [1, 1, 1, -1]
    assert torch.equal(made.images[1, 0, 1:4, 5:9], torch.ones(3, 4))
    assert not made.images[3].any()


def test_small_and_lost_objects_are_counted_not_fatal(caplog: pytest.LogCaptureFixture) -> None:
    opacity = torch.zeros(3, 8, 10)
    opacity[0, 0, :3] = 1.0
    opacity[1, :4] = 1.0
    nuisance = Nuisance(torch.zeros(3, 3, 8, 10), torch.zeros(3, 2, dtype=torch.long))
    with caplog.at_level(logging.DEBUG):
        made = Synthesizer(ProceduralClutter(), 0.0, minimum_area=4).compose(
            opacity[..., None].expand(-1, -1, -1, 3), opacity, nuisance, 0, torch.zeros(3, dtype=torch.long)
        )
    assert made.present[:, 0].tolist() == [False, True, False]
    assert images_without_boxes(made) == 2
    assert "2 of 3 images without a box" in caplog.text


def test_nuisance_is_reproducible_and_selectable(synthesizer: Synthesizer) -> None:
    first, again = (
        synthesizer.draw_nuisance(6, CAMERA, torch.Generator().manual_seed(seed)) for seed in (7, 7)
    )
    other = synthesizer.draw_nuisance(6, CAMERA, torch.Generator().manual_seed(8))
    assert torch.equal(first.backgrounds, again.backgrounds)
    assert torch.equal(first.shifts, again.shifts)
    assert not torch.equal(first.backgrounds, other.backgrounds)
    assert first.backgrounds.shape == (6, 3, 8, 10)
    part = first.select(torch.tensor([5, 0]))
    assert len(part) == 2
    assert torch.equal(part.backgrounds[0], first.backgrounds[5])

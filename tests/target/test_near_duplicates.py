"""Next to the same photographs against different ones: pictures made here, and real frames where there are any."""

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.target.near_duplicates import ALIKE, correlation, near_duplicates, thumbnail

SIDE = 96


def fields(n: int, exponent: float, top: float, generator: torch.Generator, side: int = SIDE) -> Tensor:
    """Random pictures whose amplitudes fall as f^-exponent, as those of natural scenes do with 1 (Field 1987), with a
    top brighter by ``top`` standard deviations."""
    frequency = torch.fft.fftfreq(2 * side)
    radius = (frequency[:, None].square() + frequency.square()).sqrt()
    radius[0, 0] = 1.0
    white = torch.fft.fft2(torch.randn(n, 2 * side, 2 * side, generator=generator))
    made = torch.fft.ifft2(white / radius**exponent).real[:, :side, :side]
    made = (made - made.mean((1, 2), keepdim=True)) / made.std((1, 2), keepdim=True)
    made = made + top * torch.linspace(1.0, -1.0, side)[:, None]
    return (0.5 + 0.15 * made).clamp(0.0, 1.0)[:, None].expand(-1, 3, -1, -1)


def thumbnails(pictures: Tensor) -> Tensor:
    return torch.stack([thumbnail(picture) for picture in pictures])


KINDS = {
    "1/f": lambda n, g, side: fields(n, 1.0, 0.0, g, side),
    "1/f under a bright sky": lambda n, g, side: fields(n, 1.0, 1.7, g, side),
    "smooth": lambda n, g, side: fields(n, 1.5, 0.0, g, side),
    "clutter": lambda n, g, side: ProceduralClutter().draw(n, side, side, g),
}


@pytest.mark.parametrize("kind", KINDS)
def test_different_pictures_are_told_apart(kind: str, generator: torch.Generator) -> None:
    held = thumbnails(KINDS[kind](200, generator, SIDE))
    assert correlation(held, held)[~torch.eye(200, dtype=torch.bool)].max() < ALIKE
    assert not near_duplicates(held[:60], held[60:]).test


@pytest.mark.parametrize("kind", ["1/f", "clutter"])
@pytest.mark.parametrize("shift", [0.01, 0.02, 0.04, 0.08])
def test_frames_of_a_moved_camera_are_found(kind: str, shift: float, generator: torch.Generator) -> None:
    large, step = KINDS[kind](50, generator, 2 * SIDE), round(shift * 1.6 * SIDE)
    width = round(1.6 * SIDE)
    first, second = large[..., :width, :width], large[..., step : step + width, step : step + width]
    second = 1.15 * second + 0.03 * second.std() * torch.randn(second.shape, generator=generator)
    assert (correlation(thumbnails(first), thumbnails(second)).diagonal() >= ALIKE).sum() >= 45


def test_real_frames_of_a_video_are_found_and_other_scenes_are_not(shared_data) -> None:
    scenes = sorted((shared_data / "ycb_video_sample" / "data").iterdir())
    frames = [[np.asarray(Image.open(path).convert("RGB")) for path in sorted(scene.glob("*-color.png"))]
              for scene in scenes]  # fmt: skip
    held = [thumbnails(torch.from_numpy(np.stack(scene)).movedim(-1, 1).float() / 255.0) for scene in frames]
    for i, scene in enumerate(held):
        assert near_duplicates(scene[:2], scene[2:]).test == [0, 1, 2]
        others = torch.cat([other for j, other in enumerate(held) if j != i])
        assert not near_duplicates(scene, others).test


def test_a_pair_is_named_by_its_rows(generator: torch.Generator) -> None:
    held = thumbnails(fields(12, 1.0, 0.0, generator))
    found = near_duplicates(held[:6], torch.cat([held[6:], held[2:3]]))
    assert (found.test, found.val, found.compared) == ([6], [2], 7)
    few = near_duplicates(held, held[:9], limit=3)
    assert (few.test, few.val, few.compared) == ([0, 4, 8], [0, 4, 8], 3)


def test_plain_photographs_look_like_nothing() -> None:
    """Of any size: cells are means of pixels, repeated where there are fewer pixels than cells."""
    plain = thumbnails(torch.full((2, 3, 50, 31), 0.3))
    assert not near_duplicates(plain, plain).test
    corner = torch.zeros(1, 3, 2, 2)
    corner[..., 0, 0] = 1.0
    assert near_duplicates(thumbnails(corner), thumbnails(corner)).test == [0]

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neural_sim.synthesis.background import PhotoFolder, ProceduralClutter


def test_clutter_is_reproducible_and_in_range() -> None:
    clutter = ProceduralClutter()
    first = clutter.draw(20, 24, 36, torch.Generator().manual_seed(1))
    again = clutter.draw(20, 24, 36, torch.Generator().manual_seed(1))
    assert torch.equal(first, again)
    assert first.shape == (20, 3, 24, 36)
    assert first.min() >= 0.0
    assert first.max() <= 1.0
    assert torch.isfinite(first).all()


def test_no_two_images_are_alike() -> None:
    images = ProceduralClutter().draw(20, 24, 24, torch.Generator().manual_seed(2)).flatten(1)
    distance = torch.cdist(images, images) / images.shape[1] ** 0.5
    assert (distance + torch.eye(20)).min() > 0.1
    assert images.std(1).min() > 0.05


def test_distractors_put_red_and_blue_into_most_images() -> None:
    """A pixel is red (blue) where that channel exceeds both others by 0.25."""

    def share(clutter: ProceduralClutter, channel: int) -> float:
        images = clutter.draw(32, 24, 24, torch.Generator().manual_seed(3))
        others = torch.cat([images[:, :channel], images[:, channel + 1 :]], 1).amax(1)
        strong = (images[:, channel] - others > 0.25).float().mean((1, 2))
        return float((strong > 0.02).float().mean())

    for channel in (0, 2):
        assert share(ProceduralClutter(distractors=0.4), channel) > 0.6
        assert share(ProceduralClutter(distractors=0.0), channel) < 0.3


def test_extremes_of_the_settings_and_of_the_size() -> None:
    plain = ProceduralClutter(octaves=1, contrast=0.0, shapes=0, grain=0.0)
    images = plain.draw(2, 5, 5, torch.Generator().manual_seed(4))
    assert torch.equal(images, images[:, :, :1, :1].expand_as(images))
    assert ProceduralClutter(shapes=1).draw(1, 1, 1, torch.Generator()).shape == (1, 3, 1, 1)
    assert ProceduralClutter().draw(0, 8, 8, torch.Generator()).shape == (0, 3, 8, 8)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A wide photo whose red is the column and green the row, and a plain blue one in a folder below."""
    ramp = np.zeros((40, 80, 3), dtype=np.uint8)
    ramp[..., 0], ramp[..., 1] = np.arange(80), 2 * np.arange(40)[:, None]
    Image.fromarray(ramp).save(tmp_path / "ramp.png")
    (tmp_path / "below").mkdir()
    Image.new("RGB", (30, 90), (0, 0, 255)).save(tmp_path / "below" / "blue.JPG")
    (tmp_path / "notes.txt").write_text("no photograph")
    return tmp_path


def test_crops_keep_the_aspect_ratio_and_vary(photos: Path) -> None:
    images = PhotoFolder(photos, smallest=0.5).draw(40, 16, 16, torch.Generator().manual_seed(5))
    blue = images[:, 2].mean((1, 2)) > 0.9
    assert 5 < int(blue.sum()) < 35
    ramps = 255 * images[~blue]
    across = (ramps[:, 0, 8, 13] - ramps[:, 0, 8, 2]) / 11  # source columns per pixel
    down = (ramps[:, 1, 13, 8] - ramps[:, 1, 2, 8]) / 22  # source rows per pixel
    assert (across - down).abs().max() < 0.15
    assert across.min() > 0.5 * 40 / 16 - 0.15
    assert across.max() < 40 / 16 + 0.15
    assert across.std() > 0.1


def test_a_whole_photo_is_a_crop_whatever_rounding_does_to_its_size(tmp_path: Path) -> None:
    """3 / 187 * 187 is more than 3 in floating point."""
    Image.new("RGB", (3, 3), (0, 0, 255)).save(tmp_path / "small.png")
    images = PhotoFolder(tmp_path, smallest=1.0).draw(3, 187, 187, torch.Generator().manual_seed(0))
    assert torch.equal(images, torch.tensor([0.0, 0.0, 1.0])[None, :, None, None].expand_as(images))


def test_photo_crops_are_reproducible(photos: Path) -> None:
    folder = PhotoFolder(photos)
    draws = [folder.draw(6, 12, 20, torch.Generator().manual_seed(6)) for _ in range(2)]
    assert torch.equal(*draws)
    assert draws[0].shape == (6, 3, 12, 20)


def test_the_digest_follows_the_photos_not_their_place(
    photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    first = PhotoFolder(photos).digest()
    moved = photos.rename(tmp_path_factory.mktemp("elsewhere") / "photos")
    assert PhotoFolder(moved).digest() == first
    held = bytearray((moved / "ramp.png").read_bytes())
    held[-1] ^= 1  # the size stays
    (moved / "ramp.png").write_bytes(held)
    second = PhotoFolder(moved).digest()
    Image.new("RGB", (9, 9)).save(moved / "new.png")
    assert len({first, second, PhotoFolder(moved).digest()}) == 3


def test_missing_empty_and_broken_photos_are_refused_with_their_path(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nowhere"):
        PhotoFolder(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"no photograph .* in {tmp_path}"):
        PhotoFolder(tmp_path)
    (tmp_path / "broken.png").write_bytes(b"not an image")
    with pytest.raises(ValueError, match=r"PhotoFolder\.root: .*broken\.png: not a readable image"):
        PhotoFolder(tmp_path).draw(1, 8, 8, torch.Generator())


def test_another_device_gets_the_cpus_clutter_in_two_copies_a_chunk(pretend):
    made = [
        ProceduralClutter().draw(20, 16, 24, torch.Generator().manual_seed(7), d) for d in ("cpu", "pretend")
    ]
    assert made[1].device.type == "pretend" and torch.equal(made[1].cpu(), made[0])
    assert pretend.count("to_device") == 2 * 2 and not pretend.count("wait")

"""Parts of photographs: whole groups in each, what groups are by, and which photographs look alike."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.target.split import (
    ALIKE,
    Split,
    correlation,
    groups_of,
    joined,
    near_duplicates,
    nearest,
    split,
    thumbnail,
)

FILE = Path("val.json")
ENTRIES = [
    {"file_name": "kitchen/0001.jpg", "scene": 3},
    {"file_name": "kitchen/0002.jpg", "scene": 3},
    {"file_name": "hall/0001.jpg", "scene": "4"},
]
NAMES = [entry["file_name"] for entry in ENTRIES]
SIDE = 96


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_without_groups_parts_are_disjoint_complete_seeded_and_exact() -> None:
    (val, test), again, other = (split(range(20), 0.3, seeded(seed)) for seed in (1, 1, 2))
    order = torch.randperm(20, generator=seeded(1))
    assert val.tolist() == order[:6].tolist() and test.tolist() == order[6:].tolist()
    assert torch.equal(val, again[0]) and not torch.equal(val, other[0])


@pytest.mark.parametrize("seed", range(5))
def test_a_group_lands_in_one_part_whole(seed: int) -> None:
    groups = [f"scene {i % 7}" for i in range(60)]
    val, test = ({groups[i] for i in part.tolist()} for part in split(groups, 0.4, seeded(seed)))
    assert val and test and not val & test
    rows = torch.cat(split(groups, 0.4, seeded(seed)))
    assert sorted(rows.tolist()) == list(range(60))


def test_the_choice_of_groups_is_random() -> None:
    groups = [i // 5 for i in range(40)]
    chosen = {
        frozenset(groups[i] for i in split(groups, 0.25, seeded(seed))[0].tolist()) for seed in range(40)
    }
    assert len(chosen) > 15 and all(len(groups) == 2 for groups in chosen)  # of the 28 pairs


def test_the_share_is_the_nearest_that_groups_allow() -> None:
    """Against every subset, on random sizes and wishes."""
    generator = seeded(3)
    for _ in range(60):
        sizes = torch.randint(
            1, 30, (int(torch.randint(2, 9, (1,), generator=generator)),), generator=generator
        )
        wanted = int(torch.randint(1, int(sizes.sum()), (1,), generator=generator))
        subsets = itertools.chain.from_iterable(
            itertools.combinations(sizes.tolist(), n) for n in range(1, len(sizes))
        )
        best = min((abs(sum(subset) - wanted), sum(subset)) for subset in subsets)
        chosen = nearest(sizes.tolist(), wanted)
        assert sum(sizes[i] for i in chosen) == best[1]


def test_thousands_of_groups_take_no_time() -> None:
    groups = [i // 3 for i in range(30_000)]
    val, test = split(groups, 0.3, seeded(4))
    assert (len(val), len(test)) == (9_000, 21_000)


@pytest.mark.parametrize(("count", "fraction"), [(0, 0.5), (1, 0.5), (4, 0.1), (4, 0.9)])
def test_an_empty_part_is_refused(count: int, fraction: float) -> None:
    with pytest.raises(ValueError, match="leaves validation or test empty"):
        split(range(count), fraction, torch.Generator())


def test_one_group_and_a_fraction_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="at least two groups of images for two parts, got 1"):
        split(["a"] * 4, 0.5, torch.Generator())
    with pytest.raises(ValueError, match=r"\(0, 1\), got 1.0"):
        split(range(4), 1.0, torch.Generator())


def test_groups_that_share_an_equal_image_are_one() -> None:
    assert joined("abcd", [1, 2, 1, 3]) == [0, 1, 0, 3]
    # A chain: a and b share image 1, b and c share image 2.
    assert joined("abbc", [1, 1, 2, 2]) == [0, 0, 0, 0]
    assert joined("aab", [1, 2, 3]) == [0, 0, 2]


def test_equal_images_stay_together() -> None:
    pixels = [*range(10), *range(10)]
    for seed in range(5):
        val, test = split(joined(range(20), pixels), 0.3, seeded(seed))
        assert (len(val), len(test)) == (6, 14)
        assert not {pixels[i] for i in val} & {pixels[i] for i in test}


def test_what_is_not_scored_is_divided_into_whole_groups() -> None:
    groups = [row // 3 for row in range(30)]
    val = [row for row in range(30) if groups[row] % 2 == 0]
    parts = Split(train_fraction=0.4).unscored(val, groups, seeded(2))
    assert sorted(parts["train"] + parts["val"]) == val and len(parts["train"]) == 6
    assert not {groups[row] for row in parts["train"]} & {groups[row] for row in parts["val"]}
    assert Split().unscored(val, groups, seeded(2)) == {"val": val}
    with pytest.raises(
        ValueError, match=r"these all belong to one group, 0; want a larger target\.val_fraction"
    ):
        Split(train_fraction=0.4).unscored([0, 1, 2], groups, seeded(2))


@pytest.mark.parametrize(
    ("split_by", "groups"),
    [
        (r"^(\w+)/", ["kitchen", "kitchen", "hall"]),
        (r"^\w+", ["kitchen", "kitchen", "hall"]),
        (r"\d+", ["0001", "0002", "0001"]),
        (r"^(\w)\w+/(\d+)", ["k", "k", "h"]),
        ("attribute:scene", ["3", "3", "4"]),
    ],
)
def test_groups_by_file_name_or_attribute(split_by: str, groups: list[str]) -> None:
    assert groups_of(NAMES, split_by, FILE, ENTRIES) == groups


@pytest.mark.parametrize(
    ("split_by", "message"),
    [
        ("(", r"not a regular expression \(missing \)"),
        (r"^(\d+)/", r"3 of 3 images have no group, the first 'kitchen/0001\.jpg'"),
        (r"^(hall)/", r"2 of 3 images have no group, the first 'kitchen/0001\.jpg'"),
        (r"^kitchen(/)|hall", r"1 of 3 images have no group, the first 'hall/0001\.jpg'"),
        (r"\.jpg$", r"want at least two groups, got \['\.jpg'\]"),
        ("attribute:video", r"3 of 3 images have no group"),
        ("attribute:", r"3 of 3 images have no group"),
    ],
)
def test_what_makes_no_groups_is_refused_with_key_and_file(split_by: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        groups_of(NAMES, split_by, FILE, ENTRIES)
    assert str(caught.value).startswith(f"target.split_by={split_by!r}, val.json: ")
    assert "\n" not in str(caught.value)


def test_an_attribute_must_be_a_text_or_a_number() -> None:
    with pytest.raises(ValueError, match=r"want a text or a number, got \{'id': 1\}"):
        groups_of(["a", *NAMES], "attribute:scene", FILE, [{"scene": {"id": 1}}, *ENTRIES])
    with pytest.raises(ValueError, match=r"1 of 4 images have no group, the first 'a'"):
        groups_of(["a", *NAMES], "attribute:scene", FILE, [{"scene": None}, *ENTRIES])


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
    assert not near_duplicates(held[:60], held[60:]).second


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
        assert near_duplicates(scene[:2], scene[2:]).second == [0, 1, 2]
        others = torch.cat([other for j, other in enumerate(held) if j != i])
        assert not near_duplicates(scene, others).second


def test_a_pair_is_named_by_its_rows(generator: torch.Generator) -> None:
    held = thumbnails(fields(12, 1.0, 0.0, generator))
    found = near_duplicates(held[:6], torch.cat([held[6:], held[2:3]]))
    assert (found.second, found.first, found.compared) == ([6], [2], 7)
    few = near_duplicates(held, held[:9], limit=3)
    assert (few.second, few.first, few.compared) == ([0, 4, 8], [0, 4, 8], 3)


def test_plain_photographs_look_like_nothing() -> None:
    """Of any size: cells are means of pixels, repeated where there are fewer pixels than cells."""
    plain = thumbnails(torch.full((2, 3, 50, 31), 0.3))
    assert not near_duplicates(plain, plain).second
    corner = torch.zeros(1, 3, 2, 2)
    corner[..., 0, 0] = 1.0
    assert near_duplicates(thumbnails(corner), thumbnails(corner)).second == [0]

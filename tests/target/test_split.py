import pytest
import torch

from neural_sim.target.split import split
from neural_sim.types import LabelledImages


def numbered(n: int) -> LabelledImages:
    labels = torch.zeros(n, 1, dtype=torch.long)
    images = torch.arange(n).float().view(n, 1, 1, 1).expand(n, 3, 1, 1) / 255
    return LabelledImages(images, torch.zeros(n, 1, 4), labels, torch.arange(n))


def test_parts_are_disjoint_complete_and_seeded() -> None:
    parts = [split(numbered(20), 0.3, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    val, test = parts[0]
    assert (len(val), len(test)) == (6, 14)
    assert sorted([*val.bins.tolist(), *test.bins.tolist()]) == list(range(20))
    assert torch.equal(val.bins, parts[1][0].bins)
    assert not torch.equal(val.bins, parts[2][0].bins)


def test_equal_images_stay_together() -> None:
    twice = LabelledImages.concatenate([numbered(10), numbered(10)])
    for seed in range(5):
        val, test = split(twice, 0.3, torch.Generator().manual_seed(seed))
        assert (len(val), len(test)) == (6, 14)
        assert not set(val.bins.tolist()) & set(test.bins.tolist())
    same = LabelledImages.concatenate([numbered(1)] * 8)
    with pytest.raises(ValueError, match=r"0\.5 of 8 images, 1 of them different, leaves"):
        split(same, 0.5, torch.Generator())


@pytest.mark.parametrize(("count", "fraction"), [(1, 0.5), (4, 0.1), (4, 0.9)])
def test_an_empty_part_is_refused(count: int, fraction: float) -> None:
    with pytest.raises(ValueError, match="leaves validation or test empty"):
        split(numbered(count), fraction, torch.Generator())


def test_fraction_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"\(0, 1\), got 1.0"):
        split(numbered(4), 1.0, torch.Generator())

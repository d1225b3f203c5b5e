import itertools

import pytest
import torch

from neural_sim.target.split import for_training, joined, nearest, split


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
    parts = for_training(val, groups, 0.4, seeded(2))
    assert sorted(parts["train"] + parts["val"]) == val and len(parts["train"]) == 6
    assert not {groups[row] for row in parts["train"]} & {groups[row] for row in parts["val"]}
    assert for_training(val, groups, None, seeded(2)) == {"val": val}
    with pytest.raises(ValueError, match=r"those are of one, 0; want a larger target\.val_fraction"):
        for_training([0, 1, 2], groups, 0.4, seeded(2))

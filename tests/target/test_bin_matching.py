"""Photographs chosen by pose bin: counts by hand, parts that stay apart, and what is refused."""

import json

import pytest
import torch
from PIL import Image

from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.bin_matching import apportioned, matching, most
from neural_sim.target.coco import CocoTarget
from neural_sim.types import LabelledImages, PinholeCamera

DOMINANT = [0.86, *[0.02] * 7]


def labelled(cells):
    """An image for each (label, bin)."""
    labels, bins = (torch.tensor([[cell[i]] for cell in cells]) for i in range(2))
    return LabelledImages(torch.zeros(len(cells), 3, 1, 1), torch.zeros(len(cells), 1, 4), labels, bins)


def test_as_many_photographs_as_the_dominant_bin_has(generator):
    """43 of the dominant bin and 1 of each other are 50; 51 want 43.86 of it, which is rounded up to 44."""
    assert apportioned(DOMINANT, 50, [43, *[9] * 7], generator) == [43, *[1] * 7]
    assert most(DOMINANT, [43, *[9] * 7], generator) == [43, *[1] * 7]
    assert most([0.5, 0.5], [3, 8], generator) in ([3, 3], [3, 4])
    assert most(DOMINANT, [0, *[9] * 7], generator) is None


def test_equal_remainders_go_to_bins_that_have_photographs(generator):
    for _ in range(10):
        assert apportioned([0.25] * 4, 2, [0, 1, 0, 1], generator) == [0, 1, 0, 1]
    found = {tuple(apportioned([0.25] * 4, 1, [1] * 4, generator) or ()) for _ in range(40)}
    assert len(found) == 4, "ties are broken at random"


@pytest.mark.parametrize("total", [1, 7, 20, 33])
def test_every_count_is_the_quota_rounded_up_or_down(total, generator):
    p = torch.rand(8, generator=generator).double()
    p /= p.sum()
    counts = apportioned(p.tolist(), total, [total] * 8, generator)
    assert counts is not None and sum(counts) == total
    assert all(abs(count - total * value) < 1 for count, value in zip(counts, p.tolist(), strict=True))


def test_each_object_follows_its_own_distribution(generator):
    cells = [(label, b) for label in (0, 1) for b in range(4) for _ in range(10)]
    goals = {
        "can": torch.tensor([1.0, 0.0, 0.0, 0.0]),
        "mug": torch.full((4,), 0.25),
        "drill": torch.ones(4) / 4,
    }
    images, rows = labelled([*cells, (-1, -1), (0, -1)]), torch.arange(5, 82)
    chosen = matching(images, rows, goals, generator, "file")
    assert len(set(chosen.tolist())) == len(chosen) and set(chosen.tolist()) <= set(rows.tolist())
    found = [tuple(cell) for cell in torch.cat([images.labels, images.bins], 1)[chosen].tolist()]
    assert sorted(found) == [(0, 0)] * 5 + [(1, b) for b in range(4) for _ in range(10)]


def test_what_cannot_be_matched_is_refused(generator):
    goals = {"can": torch.tensor([1.0, 0.0])}
    with pytest.raises(ValueError, match=r"file: want can in bins as \[1.0, 0.0\], none in \[1\]"):
        matching(labelled([(0, 1)]), torch.tensor([0]), goals, generator, "file")
    with pytest.raises(ValueError, match="no photograph has a box with a pose bin"):
        matching(labelled([(0, -1)]), torch.tensor([0]), goals, generator, "file")
    two = LabelledImages(
        torch.zeros(1, 3, 1, 1), torch.zeros(1, 2, 4), torch.tensor([[0, 1]]), torch.tensor([[0, 0]])
    )
    with pytest.raises(ValueError, match="one object in one bin each"):
        matching(two, torch.tensor([0]), goals, generator, "file")


@pytest.fixture
def target(tmp_path):
    """Twelve photographs of a can in each of eight bins, three to a scene, all different."""
    images, annotations = [], []
    for number in range(96):
        Image.new("RGB", (20, 20), (number, 255 - number, 7)).save(tmp_path / f"{number}.png")
        images.append({"id": number, "file_name": f"{number}.png", "scene": number // 3})
        box = {"image_id": number, "category_id": 1, "bbox": [2, 2, 9, 9], "pose": number % 8 + 1}
        annotations.append(box)
    document = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "can"}]}
    (tmp_path / "annotations.json").write_text(json.dumps(document))
    settings = {"bin_attribute": "pose", "split_by": "attribute:scene", "val_fraction": 0.5}
    return lambda **more: CocoTarget(tmp_path / "annotations.json", **settings | more)


def test_validation_and_test_follow_the_target_and_share_no_group(target):
    distribution = SceneDistribution.of([Pose(biased={"can": {"target": {"dominant": 3}}})])
    camera, synthesizer = PinholeCamera(20, 20, 0.7), Synthesizer(ProceduralClutter())

    def parts(**more):
        sets = target(**more).sets({"can": None}, distribution, camera, synthesizer, seed=0)
        return [(s, {round(255 * float(image[0, 10, 10])) for image in s.images}) for s in sets.values()]

    (val, val_numbers), (test, test_numbers) = parts(match_bins=True)
    (_, all_val), (_, all_test) = parts()
    assert val_numbers < all_val and test_numbers < all_test
    assert not {n // 3 for n in val_numbers} & {n // 3 for n in test_numbers}
    for part in (val, test):
        counts = torch.bincount(part.bins.flatten(), minlength=8)
        assert int(counts[2]) == int(counts.max()) and len(part) > 3
        p = torch.tensor([0.02, 0.02, 0.86, *[0.02] * 5])
        assert bool(((counts - len(part) * p).abs() < 1).all())


def test_bins_are_needed_to_match_them(target):
    with pytest.raises(ValueError, match=r"target.match_bins: want target.bin_attribute"):
        target(match_bins=True, bin_attribute=None)

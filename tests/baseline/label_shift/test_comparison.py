"""Templates on painted objects, whose pose's bin shows as the place of a bright patch."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_pools import EACH, SIDE, painted
from scipy.ndimage import minimum_filter

from neural_sim.baseline.label_shift.comparison import SLOPES, Templates, _turned, rolls_of
from neural_sim.baseline.label_shift.crops import crops_of, plain
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import LabelledImages

BINS = 4


@pytest.fixture(scope="module")
def subject():
    return painted("lamp", SceneDistribution.of([Pose(bins=BINS)]))


def shown(subject, quarter_turns=0, exposure=1.0):
    """One image of each bin on noise, turned by quarters, with its box."""
    maps = subject.maps[:, 0].movedim(-1, 1).float() / 255.0
    behind = torch.rand(maps[:, :3].shape, generator=torch.Generator().manual_seed(2))
    images = maps[:, :3] + (1.0 - maps[:, 3:]) * behind
    images = (exposure * images).clamp(0.0, 1.0).rot90(quarter_turns, (2, 3))
    rows, columns = (maps[0, 3] > 0.5).nonzero().unbind(1)
    box = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
    assert box.sum() == 2 * SIDE  # centred, so that it stays where it is
    zero = torch.zeros(BINS, 1, dtype=torch.long)
    return LabelledImages(images, box.expand(BINS, 1, 4).clone(), zero, zero - 1)


def test_angles_cover_the_range_evenly_and_a_full_turn_once():
    assert rolls_of(0.0).tolist() == [0.0]
    torch.testing.assert_close(rolls_of(10.0), torch.tensor([-10.0, 0.0, 10.0]).deg2rad())
    every = rolls_of(180.0)
    assert len(every) == 24
    torch.testing.assert_close(every.diff(), torch.full((23,), math.radians(15.0)))


@pytest.mark.parametrize("exposure", [1.0, 0.4])
def test_a_crop_resembles_the_renders_of_its_bin_most(subject, exposure):
    templates = Templates.of(subject, torch.arange(BINS), 10.0)
    scores = templates(crops_of(shown(subject, exposure=exposure), False), BINS)
    assert scores.argmax(1).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_crop_resembles_its_bin_as_much_as_any_that_a_turn_makes_the_same(subject, quarters):
    """The four bins differ by quarter turns, so at any roll none of them stands out; upright, the turned one does."""
    crops = crops_of(shown(subject, quarters), False)
    upright = Templates.of(subject, torch.arange(BINS), 0.0)(crops, BINS)
    seen = [int(one.rot90(quarters, (0, 1)).flatten().argmax()) for one in torch.eye(4).view(4, 2, 2)]
    assert upright.argmax(1).tolist() == seen
    any_roll = Templates.of(subject, torch.arange(BINS), 180.0)(crops, BINS)
    assert (
        float((any_roll.amax(1) - any_roll.amin(1)).max())
        < 0.02
        < float((upright.amax(1) - upright.amin(1)).min())
    )
    assert float((any_roll.amax(1) - upright.amax(1)).abs().max()) < 0.2


def test_templates_are_cut_out_as_the_network_sees_their_boxes(subject):
    """A render and a crop of it have the same pixels wherever the object covers both."""
    crops = crops_of(shown(subject), False)
    seen = plain(crops)[0] + 0.5
    for row in range(BINS):
        cut, aspect = _turned(subject.maps[row, 0], rolls_of(0.0))
        inside = (cut[:, 3:] > 0.99).expand(-1, 3, -1, -1)
        assert float((cut[:, :3] - seen[row])[inside].abs().mean()) < 0.03
        assert float(aspect) == pytest.approx(float(crops.boxes[row, 0] - crops.boxes[row, 1]), abs=1e-5)


def directions(grey):
    """Directions of numpy's gradients, shorter than 1 where there is little slope, and the lengths of the slopes."""
    slopes = 2.0 * np.stack(np.gradient(grey, axis=(1, 0)))
    slopes[0][:, [0, -1]] = slopes[1][[0, -1]] = 0.0
    length = np.linalg.norm(slopes, axis=0)
    return slopes / (length + 0.02), length


def test_the_score_is_the_sum_of_its_three_parts(subject):
    """Colours against numpy's correlation over the object, slopes against its gradients, and the sides by hand."""
    crops = crops_of(shown(subject), False).select(torch.tensor([1]))
    templates = Templates.of(replace(subject, maps=subject.maps[:, :1]), torch.arange(BINS), 0.0)
    first = torch.tensor([1])
    inside = templates.opacity[1].numpy() > 0.0
    seen = (plain(crops)[0][0].flatten(1).numpy())[:, inside]
    weights = templates.opacity[1].numpy()[inside]
    cut = _turned(subject.maps[1, 0], rolls_of(0.0))[0][0].flatten(1).numpy()
    own = (cut[:3] / cut[3:].clip(1e-3))[:, inside]
    a, b = (each - np.average(each, axis=1, weights=weights)[:, None] for each in (seen, own))
    expected = (weights * a * b).sum() / np.sqrt((weights * a * a).sum() * (weights * b * b).sum())
    seen32 = plain(crops)[0]
    whole = float(templates._scored(seen32, crops.boxes, first))
    without = replace(templates, slopes=torch.zeros_like(templates.slopes))
    assert float(without._scored(seen32, crops.boxes, first)) == pytest.approx(expected, abs=1e-4)
    (there, _), (here, lengths) = (
        directions(each.reshape(3, 32, 32).mean(0))
        for each in (seen32[0].numpy(), cut[:3] / cut[3:].clip(1e-3))
    )
    eroded = minimum_filter(templates.opacity[1].numpy().reshape(32, 32), 3, mode="constant", cval=1.0)
    agreement = np.average((there * here).sum(0), weights=eroded * lengths / (lengths + 0.04))
    assert whole - expected == pytest.approx(SLOPES * agreement, abs=1e-4) and agreement > 0.5
    wider = crops.boxes + torch.tensor([0.3, 0.0, 0.0, 0.0, 0.0])
    assert whole - float(templates._scored(seen32, wider, first)) == pytest.approx(0.3, abs=1e-5)
    cut_off = wider + torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0])
    assert float(templates._scored(seen32, cut_off, first)) == pytest.approx(whole, abs=1e-5)


def test_cells_of_one_pose_share_their_templates_and_a_pose_that_no_render_shows_has_the_lowest_score(
    subject,
):
    crops = crops_of(shown(subject), False)
    shared = Templates.of(subject, torch.tensor([0, 0, 1, 1]), 0.0)(crops, 2)
    assert shared.argmax(1).tolist() == [0, 0, 1, 1]
    maps = subject.maps.clone()
    maps[2] = 0
    unseen = Templates.of(replace(subject, maps=maps), torch.arange(BINS), 0.0)
    assert len(unseen.poses) == 3 * EACH
    scores = unseen(crops, BINS)
    assert bool(scores.isfinite().all()) and bool((scores[:, 2] == scores.amin(1)).all())
    assert Templates.of(replace(subject, maps=torch.zeros_like(maps)), torch.arange(BINS), 0.0) is None

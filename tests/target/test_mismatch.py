"""What differs between image sets whose difference is known, and that equal sets do not differ."""

from dataclasses import replace

import pytest
import torch

from neural_sim.synthesis.sensor import Sensor, blurred, seen_by
from neural_sim.target.mismatch import (
    distance_factor,
    luma_of,
    matching_settings,
    mismatches,
    noise,
    sharpness,
    statistics,
)
from neural_sim.types import LabelledImages

SIZE = 48


def scenes(count, seed, side=16.0, objects=1, level=0.5):
    """Bright squares of about ``side`` pixels on a background, with straight edges."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.full((count, 3, SIZE, SIZE), level) + 0.05 * torch.rand(
        count, 3, 1, 1, generator=generator
    )
    boxes, labels = torch.zeros(count, 2, 4), torch.full((count, 2), -1)
    for i in range(count):
        for place in range(objects):
            wide = side * (0.9 + 0.2 * float(torch.rand(1, generator=generator)))
            x, y = ((SIZE - wide) * torch.rand(2, generator=generator)).tolist()
            boxes[i, place] = torch.tensor([x, y, x + wide, y + wide])
            labels[i, place] = place
            images[i, :, round(y) : round(y + wide), round(x) : round(x + wide)] += 0.3
    return LabelledImages(images.clamp(0, 1), boxes, labels, torch.zeros(count).long())


def degraded(images, **sensor):
    draw = Sensor(**sensor).draw(len(images), SIZE, SIZE, torch.Generator().manual_seed(5))
    return LabelledImages(seen_by(images.images, draw), images.boxes, images.labels, images.bins)


def differing(target, synthesised):
    return {m.name for m in mismatches(target, synthesised) if m.counts}


def test_sets_of_one_kind_do_not_differ():
    assert differing(scenes(40, 0), scenes(60, 1)) == set()


@pytest.mark.parametrize(
    ("target", "names"),
    [
        (scenes(40, 0, side=26.0), {"box size"}),
        (scenes(40, 0, level=0.2), {"brightness"}),
        (scenes(40, 0, objects=2), {"objects"}),
        (degraded(scenes(40, 0), noise=(0.05, 0.05)), {"noise"}),
        (degraded(scenes(40, 0), blur=(1.5, 1.5)), {"sharpness"}),
    ],
)
def test_what_was_changed_is_named(target, names):
    assert names <= differing(target, scenes(60, 1))


def test_noise_is_estimated_to_a_tenth():
    for level in (0.02, 0.05, 0.1):
        seen = degraded(scenes(30, 2), noise=(level, level))
        # Luma weights independent channels: sqrt(0.299^2 + 0.587^2 + 0.114^2) = 0.6686 of a channel's noise.
        assert float(noise(luma_of(seen.images)).median()) == pytest.approx(0.6686 * level, rel=0.1)
    assert float(noise(luma_of(scenes(30, 2).images)).max()) < 1e-6  # straight edges are no noise


def test_blur_lowers_sharpness_as_that_of_an_edge():
    luma = torch.zeros(1, SIZE, SIZE)
    luma[:, :, SIZE // 2 :] = 1.0
    assert float(sharpness(luma)) == pytest.approx(1.0)
    # The steepest step of a blurred edge is the kernel's largest weight.
    for sigma in (1.0, 2.0):
        weights = torch.exp(-0.5 * (torch.arange(-20, 21) / sigma).square())
        seen = blurred(luma[:, None], torch.tensor([sigma]))[:, 0]
        assert float(sharpness(seen)) == pytest.approx(1.0 / float(weights.sum()), rel=0.01)


def test_settings_that_match_make_the_difference_go():
    target = degraded(scenes(60, 0), blur=(0.8, 1.2), noise=(0.03, 0.05))
    plain = scenes(80, 1)
    settings = matching_settings(target, plain, mismatches(target, plain))
    noise_range = [float(v) for v in settings["synthesis.sensor.noise"].strip("[]").split(",")]
    assert 0.5 * (noise_range[0] + noise_range[1]) == pytest.approx(0.04, rel=0.2)
    blur_range = [float(v) for v in settings["synthesis.sensor.blur"].strip("[]").split(",")]
    matched = degraded(plain, blur=tuple(blur_range), noise=tuple(noise_range))
    assert not {"noise", "sharpness"} & differing(target, matched)


def test_several_objects_ask_for_as_many():
    target = scenes(40, 0, objects=2)
    assert (
        matching_settings(target, scenes(40, 1), mismatches(target, scenes(40, 1)))[
            "synthesis.objects_per_image"
        ]
        == "[2,2]"
    )


def test_an_image_is_not_asked_for_more_objects_than_there_are():
    """Synthesised images show each object once, the target's may show one of them several times."""
    two = scenes(40, 0, objects=2)
    target, synthesised = replace(two, labels=two.labels.clamp_max(0)), scenes(40, 1)
    found = matching_settings(target, synthesised, mismatches(target, synthesised))
    assert found["synthesis.objects_per_image"] == "[1,1]"
    empty = replace(two, labels=torch.full_like(two.labels, -1))
    found = matching_settings(empty, synthesised, mismatches(empty, synthesised))
    assert found["synthesis.objects_per_image"] == "[0,1]"


def test_a_target_with_larger_boxes_asks_for_nearer_cameras():
    assert distance_factor(mismatches(scenes(40, 0, side=24.0), scenes(40, 1, side=12.0))) == pytest.approx(
        0.5, rel=0.05
    )
    assert distance_factor(mismatches(scenes(40, 0), scenes(40, 1))) is None


def test_images_without_boxes_have_no_sizes_and_are_compared_in_the_rest():
    empty = scenes(20, 0, objects=0)
    names = {m.name for m in mismatches(empty, scenes(20, 1))}
    assert "box size" not in names and {"brightness", "objects"} <= names
    assert len(statistics(empty)["box size"]) == 0

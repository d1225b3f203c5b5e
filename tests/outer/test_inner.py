"""The inner problem: how long an iteration trains."""

import pytest
import torch
from small_loop import small_loop

from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.derivative import object_images


@pytest.mark.parametrize(
    ("least", "start", "steps"),
    [
        (0, "fresh", 3),  # an epoch of 12 images in batches of 4
        (3, "fresh", 3),
        (4, "fresh", 6),
        (10, "warm", 12),
        (10, "previous", 3),  # goes on from iteration to iteration
    ],
)
def test_few_images_are_trained_on_for_more_epochs(scene, least, start, steps):
    module = small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), pool_per_bin=2, least_steps=least, start=start
    )
    assert module.train_on(torch.zeros(2, 4)).cost.detector_steps == steps


@pytest.mark.parametrize(
    "estimator", [StratifiedEstimator(probes_per_bin=2), PathwiseEstimator(mode="forward")]
)
def test_maps_of_objects_are_kept_only_where_a_derivative_goes_through_them(scene, estimator):
    module = small_loop(scene, estimator)
    rendered = module.inner.draw(torch.zeros(2, 4), module.numbers)
    relaxed = isinstance(estimator, PathwiseEstimator)
    assert len(rendered) == 12 and [len(part.draw) for part in rendered.objects] == [6, 6]
    assert [len(part.rgb) for part in rendered.objects] == [6 * relaxed] * 2
    assert len(rendered.compose) == 2 * relaxed
    by_object = object_images(scene, rendered, torch.zeros(2, 4), torch.ones(12))
    assert all((images.images is not None) == relaxed for images in by_object.values())

"""The inner problem: how long an iteration trains."""

import pytest
import torch
from small_loop import small_loop

from neural_sim.gradient.estimators import StratifiedEstimator


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
    inner = small_loop(
        scene, StratifiedEstimator(probes_per_bin=2), pool_per_bin=2, least_steps=least, start=start
    ).inner
    inner.train(inner.training_set(inner.draw(torch.zeros(2, 4)).images))
    assert inner.steps == steps

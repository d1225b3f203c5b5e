"""The inner problem: how long an iteration trains, what it keeps, and whose renders it composes."""

import pytest
import torch
from small_loop import TINY, small_loop

from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.derivative import object_images
from neural_sim.outer.inner import InnerLoop, LoopInputs, Numbers, RenderedPool
from neural_sim.outer.settings import Outer


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


def test_a_pool_that_was_rendered_before_changes_no_number(scene):
    """Preflight renders it for its estimate; the loop then goes on from the generator's state."""
    detector, psi = RetinaNet(**TINY), torch.zeros(2, 4)
    params = detector.init(torch.Generator().manual_seed(1))
    validation = scene.training_set(psi, 2, torch.Generator().manual_seed(2)).images
    settings = Outer(pool_per_bin=2, images_per_object=3, epochs=1)

    def images(pool):
        generator = torch.Generator().manual_seed(0)
        inputs = LoopInputs(detector, params, validation, pool=pool)
        inner = InnerLoop.prepare(scene, inputs, settings, Training(batch_size=4), generator)
        return inner, inner.draw(psi, Numbers(generator)).images.images

    (own, drawn), pool = images(None), RenderedPool.of(scene, 2, torch.Generator().manual_seed(0))
    given, again = images(pool)
    assert given.pool is pool.scene and given.preparation == pool.spent
    assert torch.equal(drawn, again)
    assert all(torch.equal(given.start[name], value) for name, value in own.start.items())

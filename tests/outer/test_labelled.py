"""The worth of labelled photographs, against trainings that had them from the start."""

import pytest
import torch
from small_loop import MICRO, small_loop

from neural_sim.detector.real import Real
from neural_sim.detector.training import Training
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.labelled import Labelled, equivalent, labelled_gains


@pytest.fixture
def loop(scene):
    estimator = StratifiedEstimator(probes_per_bin=2)
    return small_loop(scene, estimator, detector=MICRO, pool_per_bin=2, steps="checked", train_first=True)


@pytest.fixture
def photographs(scene):
    return scene.training_set(torch.zeros(2, 4), 4, torch.Generator().manual_seed(5)).images


def test_gains_are_those_of_trainings_with_and_without_the_photographs(loop, photographs):
    theta, images, psi = loop.inner.theta, loop.inner.images, loop.psi.clone()
    first, second = labelled_gains(loop, photographs, (3, 50), trials=2, seed=7)
    assert (first.photographs, second.photographs) == (3, 8)  # there are eight
    assert loop.inner.theta is theta and loop.inner.images == images and torch.equal(loop.psi, psi)
    falls = []
    for numbers in range(2):
        losses = []
        for count in (0, 3):
            real = Real("combined", count=count)
            inner = InnerLoop(
                loop.scene, loop.inner.detector, theta, loop.inner.objective.images, loop.settings,
                Training(batch_size=4, weight_decay=0.0, real=real),
                torch.Generator().manual_seed(loop.inner.generator.initial_seed()), loop.inner.draws,
                real.chosen(photographs, 7) if count else None,
            )  # fmt: skip
            # Pool and initial parameters come from a generator that has gone on, so they are those of the loop.
            inner.pool, inner._start = loop.inner.pool, loop.inner._start
            inner.common_numbers, inner._numbers = True, numbers
            inner.train(inner.training_set(inner.draw(psi).images))
            losses.append(inner.validation_loss())
        falls.append(losses[0] - losses[1])
    assert first.fall == pytest.approx(sum(falls) / 2, abs=1e-6)
    assert first.error == pytest.approx(abs(falls[0] - falls[1]) / 2, abs=1e-6)
    assert first.fall != second.fall != 0.0


def test_numbers_in_between_are_interpolated():
    gains = [Labelled(25, 0.4, None), Labelled(10, 0.1, None)]
    assert equivalent(gains, 0.05) == pytest.approx(5.0)
    assert equivalent(gains, 0.1) == pytest.approx(10.0)
    assert equivalent(gains, 0.25) == pytest.approx(17.5)
    assert equivalent(gains, 0.5) is None
    harmful = [Labelled(10, -0.1, None), Labelled(25, 0.1, None)]
    assert equivalent(harmful, 0.05) == pytest.approx(10.0 + 15.0 * 0.75)


def test_bad_numbers_are_refused(loop, photographs):
    with pytest.raises(ValueError, match="counts of at least 1, got 1, "):
        labelled_gains(loop, photographs, (0,), 1, 0)
    with pytest.raises(ValueError, match="trials >= 1"):
        labelled_gains(loop, photographs, (1,), 0, 0)

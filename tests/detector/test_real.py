"""Photographs in a training: which of them, how batches are drawn, and the loss that this means."""

import itertools

import pytest
import torch

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.real import Real, Sampling, shuffled_passes
from neural_sim.detector.training import Batches, Optimisation, train_detector
from neural_sim.types import LabelledImages


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_fewer_photographs_are_some_of_more_and_depend_on_the_seed_alone(tools):
    photographs = tools.images(40)
    ten, twenty_five, again, other = (
        Real("combined", count=count).chosen(photographs, seed)
        for count, seed in ((10, 1), (25, 1), (10, 1), (10, 2))
    )
    assert torch.equal(ten.images, twenty_five.images[:10]) and torch.equal(ten.images, again.images)
    assert not torch.equal(ten.images, other.images)
    rows = {photograph.numpy().tobytes() for photograph in twenty_five.images}
    assert len(rows) == 25 and rows < {photograph.numpy().tobytes() for photograph in photographs.images}
    assert torch.equal(ten.labels, twenty_five.labels[:10])


def test_a_fraction_is_of_all_and_at_least_one(tools):
    photographs = tools.images(40)
    assert len(Real("pretrain", fraction=0.1).chosen(photographs, 0)) == 4
    assert len(Real("pretrain", fraction=0.01).chosen(photographs, 0)) == 1
    assert len(Real("pretrain").chosen(photographs, 0)) == 40


@pytest.mark.parametrize("photographs", [None, 4])
def test_too_few_photographs_are_refused(tools, photographs):
    given = None if photographs is None else tools.images(photographs)
    with pytest.raises(ValueError, match=f"want 5 photographs or more to train on, got {photographs or 0}"):
        Real("combined", count=5).chosen(given, 0)


def test_fewer_photographs_than_asked_for_are_all_taken_where_that_is_allowed(tools, caplog):
    taken = Real("combined", count=5, fewer="all").chosen(tools.images(4), 0)
    assert len(taken) == 4 and "4 photographs instead of 5" in caplog.text
    with pytest.raises(ValueError, match="want 5 photographs or more"):
        Real("combined", count=5, fewer="all").chosen(None, 0)


def test_no_photographs_are_no_mode():
    assert not Real().used and not Real("combined", count=0).used and not Real("pretrain").combined
    assert Real("combined").combined and Real("pretrain").used


def test_every_batch_has_its_fraction_and_every_image_its_turn():
    sampling = Real("combined", batch_fraction=0.3).sampling(20, 7, 10)
    assert sampling == Sampling((20, 7), (7, 3), 2)
    rows = torch.stack(list(itertools.islice(sampling.batches(seeded()), 140)))
    assert ((rows >= 20).sum(1) == 3).all()
    # 140 batches have 980 of 20 and 420 of 7: 49 and 60 whole passes.
    assert torch.bincount(rows.flatten()).tolist() == [49] * 20 + [60] * 7
    torch.testing.assert_close(sampling.weights, torch.tensor([0.7 / 20] * 20 + [0.3 / 7] * 7))


@pytest.mark.parametrize(("fraction", "real"), [(0.01, 1), (0.99, 3), (0.5, 2)])
def test_a_batch_has_images_of_both(fraction, real):
    assert Real("combined", batch_fraction=fraction).sampling(9, 5, 4).per_batch == (4 - real, real)
    assert Real("combined", batch_fraction=None).sampling(9, 5, 4) is None
    with pytest.raises(ValueError, match=r"at least one image of each pool.*got \(4, 0\) of \(9, 5\)"):
        Sampling((9, 5), (4, 0), 2)


def test_passes_are_whole_and_shuffled():
    turns = list(itertools.islice(shuffled_passes(5, 2, seeded()), 10))
    rows = torch.cat(turns).view(4, 5)
    assert (rows.sort(1).values == torch.arange(5)).all() and len({tuple(row) for row in rows.tolist()}) > 1


def test_a_training_has_as_many_steps_as_without_photographs_and_meets_the_weighted_loss(tools):
    """At a learning rate of zero, the mean of all batches' losses is that of all images by their weights."""
    detector, how = tools.detector(), Optimisation(7, batch_size=4, learning_rate=0.0)
    params, images = detector.init(seeded()), tools.images(10, dtype=torch.float32)
    cached = CachedSet.of(detector, detector.split(params)[0], images)
    sampling = Real("combined").sampling(7, 3, 4)
    _, history = train_detector(detector, params, cached, seeded(), how, sampling=sampling)
    assert history.steps == 2 * 7
    _, synthetic = train_detector(detector, params, cached.select(torch.arange(7)), seeded(), how)
    assert synthetic.steps == history.steps
    # 28 of 7 images and 28 of 3: 4 whole passes, and 9 and a third, whose odd image the tolerance has room for.
    losses = cached.losses(detector.split(params)[1], torch.arange(10))
    met = sum(history.losses) / 7
    spread = float(losses[7:].max() - losses[7:].min())
    assert abs(met - float(losses @ sampling.weights)) <= spread / 28 + 1e-5


def test_images_and_features_train_alike(tools):
    """Of a frozen backbone; the rows drawn are the same."""
    detector, how = tools.detector(), Optimisation(2, batch_size=4, learning_rate=1e-2)
    params, drawn, photographs = detector.init(seeded()), tools.images(6, seed=1), tools.images(3, seed=2)
    params = {name: value.double() for name, value in params.items()}
    backbone = detector.split(params)[0]
    joined = LabelledImages.concatenate([drawn, photographs])
    parts = [CachedSet.of(detector, backbone, images) for images in (drawn, photographs)]
    sampling = Real("combined").sampling(6, 3, 4)
    one, other = (
        train_detector(detector, params, images, seeded(4), how, sampling=sampling)[0]
        for images in (CachedSet.of(detector, backbone, joined), CachedSet.concatenate(parts))
    )
    for name, value in one.items():
        torch.testing.assert_close(value, other[name], rtol=1e-12, atol=1e-12)


def test_a_sampling_of_other_images_is_refused(tools):
    images, detector = tools.images(5), tools.detector()
    targets = detector.assign(images.boxes, images.labels)
    with pytest.raises(ValueError, match="want 9 images, got 5"):
        Batches((images.images,), targets, 4, seeded(), Sampling((6, 3), (2, 2), 2))

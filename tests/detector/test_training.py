import math

import pytest
import torch
from torchvision.models import resnet18

from neural_sim.detector.cached_set import CachedSet, cached_features
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Backbone, Head
from neural_sim.detector.training import DetectorModule, Optimisation, train_detector
from neural_sim.types import LabelledImages


def train(detector, params, images, seed=5, anchor=None, **changes):
    how = Optimisation(**{"epochs": 2, "batch_size": 3, "learning_rate": 1e-2, **changes})
    return train_detector(detector, params, images, torch.Generator().manual_seed(seed), how, anchor)


@pytest.fixture
def images(tools):
    return tools.images(8, dtype=torch.float32)


def test_same_seed_is_bit_identical(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    first, history = train(detector, start, images)
    again, repeated = train(detector, start, images)
    other, _ = train(detector, start, images, seed=6)
    assert history == repeated
    assert history.steps == 6
    assert len(history.losses) == 2
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)
    assert list(first) == list(start)


def test_all_parameters_are_trained_and_the_given_ones_kept(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    kept = {name: value.clone() for name, value in start.items()}
    trained, _ = train(detector, start, images)
    assert all(torch.equal(start[name], kept[name]) for name in start)
    assert all(not torch.equal(trained[name], start[name]) for name in start)
    assert not any(value.requires_grad for value in trained.values())


def test_frozen_backbone_is_frozen_and_gives_the_same_loss(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    features = CachedSet.of(detector, detector.split(start)[0], images)
    trained, history = train(detector, start, features)
    backbone, trainable = detector.split(trained)
    assert all(torch.equal(value, start[name]) for name, value in backbone.items())
    assert all(not torch.equal(value, start[name]) for name, value in trainable.items())
    assert history.losses[-1] < history.losses[0]
    for cached, direct in zip(
        cached_features(detector, backbone, images.images, 3),
        detector.features(backbone, images.images),
        strict=True,
    ):
        torch.testing.assert_close(cached, direct, rtol=1e-4, atol=1e-5)


def test_training_overfits_a_few_images(tools, generator):
    detector = tools.detector(head={"channels": 16})
    images = tools.images(4, dtype=torch.float32)
    start = detector.init(generator)
    trained, history = train(detector, start, images, epochs=60, batch_size=4)
    assert tools.mean_loss(detector, trained, images) < 0.1 * tools.mean_loss(detector, start, images)
    assert history.losses[-1] < 0.2 * history.losses[0]


def test_one_image_and_no_boxes_at_all(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    _, history = train(detector, start, images.select(slice(0, 1)), batch_size=1)
    assert all(math.isfinite(loss) for loss in history.losses)
    empty = LabelledImages(
        images.images, torch.zeros(8, 0, 4), torch.zeros(8, 0, dtype=torch.long), images.bins
    )
    _, history = train(detector, start, empty)
    assert all(math.isfinite(loss) for loss in history.losses)


def test_a_training_that_diverges_is_refused_with_its_epoch_and_rate(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    with pytest.raises(
        ValueError, match=r"loss is (nan|inf) in epoch \d of 3, at a learning rate of 1e\+30: want"
    ):
        train(detector, start, images, epochs=3, learning_rate=1e30)


def test_nothing_to_train_on_is_refused(tools, generator, images):
    detector = tools.detector()
    start = detector.init(generator)
    with pytest.raises(ValueError, match="train_detector"):
        train(detector, start, images.select(slice(0, 0)))
    with pytest.raises(ValueError, match="no images"):
        CachedSet.of(detector, detector.split(start)[0], images.select(slice(0, 0)))
    assert detector.predict(start, images.images[:0]) == []


def test_a_proximal_term_joins_the_steps_and_stays_out_of_the_history(tools, generator, images):
    detector = tools.detector(proximal=3.0)
    backbone, start = detector.split(detector.init(generator))
    anchor = {name: value + 0.1 for name, value in start.items()}
    targets = detector.assign(images.boxes, images.labels)
    features = cached_features(detector, backbone, images.images)
    module = DetectorModule(detector, start, backbone, Optimisation(1), 1, anchor)
    added = float(module.training_step((features, targets), 0).detach()) - float(
        detector.per_image_loss(start, features, targets).mean()
    )
    assert added == pytest.approx(1.5 * sum(value.numel() for value in start.values()) * 0.01, rel=1e-4)
    module.on_train_epoch_end()
    module.on_train_end()
    wanted = float(detector.per_image_loss(start, features, targets).mean())
    assert module.epoch_losses == [pytest.approx(wanted, rel=1e-6)]


def test_a_proximal_term_holds_training_at_its_anchor(tools, generator, images):
    start = tools.detector().init(generator)

    def distance(proximal):
        detector = tools.detector(proximal=proximal)
        features = CachedSet.of(detector, detector.split(start)[0], images)
        trained, _ = train(detector, start, features, anchor=start, epochs=40, weight_decay=0.0)
        return math.sqrt(sum(float((trained[n] - start[n]).square().sum()) for n in start))

    assert distance(100.0) < 0.1 * distance(1.0) < 0.1 * distance(0.0)


class Bare(RetinaNet):
    """No parameter's name begins with ``backbone.``, and the features are the images."""

    def init(self, generator):
        return {name.replace("backbone.", "body."): value for name, value in super().init(generator).items()}

    def learnable(self, params):
        return list(params)

    def features(self, backbone, images):
        return (images,)

    def outputs(self, trainable, features):
        named = {name.replace("body.", "backbone."): value for name, value in trainable.items()}
        backbone, rest = self.split(named)
        return super().outputs(rest, super().features(backbone, features[0]))


def test_a_detector_without_a_backbone_trains(generator, images):
    detector = Bare(3, 32, Backbone("micro"), Head(8, 1))
    start = detector.init(generator)
    trained, _ = train(detector, start, images)
    assert all(not torch.equal(trained[name], start[name]) for name in start)


def test_what_is_not_learnable_stays_even_if_the_backbone_is_frozen(tools, generator, images):
    detector, names = tools.detector(), []

    def learnable(params):
        return names

    detector.learnable = learnable
    start = detector.init(generator)
    head = [name for name in start if name.startswith("head.")]
    for names in (head, [*head, *detector.split(start)[0]]):
        trained, _ = train(detector, start, images)
        assert {name for name in start if not torch.equal(trained[name], start[name])} == set(names)


def test_a_detector_may_keep_its_weights_in_every_training(tools, generator, images, tmp_path):
    torch.manual_seed(0)
    torch.save(resnet18().state_dict(), tmp_path / "resnet18.pth")
    settings = {"architecture": "resnet18", "weights": str(tmp_path / "resnet18.pth")}
    detector = tools.detector({**settings, "freeze": True})
    start = detector.init(generator)
    backbone, trainable = detector.split(start)
    assert set(detector.learnable(start)) == set(trainable)
    trained, history = train(detector, start, images)
    assert all(torch.equal(trained[name], value) for name, value in backbone.items())
    assert not any(torch.equal(trained[name], value) for name, value in trainable.items())
    on_features, same = train(detector, start, CachedSet.of(detector, backbone, images))
    assert history == same and all(torch.equal(trained[name], on_features[name]) for name in start)
    free = tools.detector(settings)
    assert any("backbone" in name for name in free.learnable(start))

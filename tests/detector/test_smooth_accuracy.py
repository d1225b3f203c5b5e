"""Top-1 accuracy against torchmetrics', and its smooth stand-in against it and against central differences."""

import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.metrics import AveragePrecision, evaluate, mean_of, of_document
from neural_sim.detector.settings import Backbone
from neural_sim.detector.smooth_scores import SmoothAccuracy
from neural_sim.types import LabelledImages

NAMES = ("a", "b", "c")
DETECTOR = Classifier(3, 32, Backbone("micro"))


@pytest.fixture
def case(generator):
    """Logits of 20 images with one object each, of which the right class is often the best; two images have none."""
    labels = torch.randint(0, 3, (20, 1), generator=generator)
    logits = torch.randn(20, 1, 3, generator=generator).double()
    logits = logits + 0.8 * torch.nn.functional.one_hot(labels, 3)
    labels[[4, 11]] = -1
    boxes = torch.tensor([1.0, 1, 9, 9]).expand(20, 1, 4)
    return logits, LabelledImages(torch.zeros(20, 3, 32, 32), boxes, labels, torch.full((20,), -1))


def predictions(logits):
    scores, labels = logits[:, 0].softmax(-1).max(-1)
    box = torch.tensor([[0.0, 0, 32, 32]])
    return [{"boxes": box, "scores": s[None], "labels": n[None]} for s, n in zip(scores, labels, strict=True)]


def accuracies(logits, images):
    """torchmetrics' of every class, of the images with an object."""
    own = images.labels[:, 0] >= 0
    return MulticlassAccuracy(3, average=None)(logits[own, 0], images.labels[own, 0]).tolist()


def test_accuracy_is_torchmetrics(case):
    logits, images = case
    found = evaluate(predictions(logits), images, NAMES, "accuracy")
    wanted = accuracies(logits, images)
    assert list(found.per_class.values()) == pytest.approx(wanted, abs=1e-7)
    assert found.mean == pytest.approx(sum(wanted) / 3, abs=1e-7) and 0.0 < found.mean < 1.0


def test_a_class_without_images_stays_out_of_the_mean(case):
    logits, images = case
    rows = (images.labels[:, 0] != 1).nonzero()[:, 0]
    found = evaluate(predictions(logits[rows]), images.select(rows), NAMES, "accuracy")
    assert found.per_class["b"] != found.per_class["b"]
    assert found.mean == pytest.approx(0.5 * (found.per_class["a"] + found.per_class["c"]))


def test_no_prediction_is_wrong_and_two_classes_in_an_image_are_refused(case):
    logits, images = case
    nothing = [{key: value[:0] for key, value in each.items()} for each in predictions(logits)]
    assert evaluate(nothing, images, NAMES, "accuracy").mean == 0.0
    two = LabelledImages.concatenate([images, images])
    two = LabelledImages(
        two.images, two.boxes.repeat(1, 2, 1), torch.cat([two.labels, 1 - two.labels], 1), two.bins
    )
    with pytest.raises(ValueError, match="want objects of one class in an image"):
        evaluate(predictions(logits.repeat(2, 1, 1)), two, NAMES, "accuracy")


def test_documents_of_both_scores_are_read_back(case):
    logits, images = case
    found = evaluate(predictions(logits), images, NAMES, "accuracy")
    assert of_document({"accuracy": found.accuracy, "per_class": found.per_class}) == found
    ap = AveragePrecision(0.5, 0.75, {"a": 0.5}, {"a": 0.75})
    assert of_document(vars(ap)) == ap and (mean_of(vars(ap)), mean_of(vars(found))) == (0.5, found.accuracy)


def test_its_limit_is_accuracy(case):
    logits, images = case
    smooth = SmoothAccuracy(temperature=1e-4)(DETECTOR, (logits, torch.zeros(20, 1, 4)), images)
    assert smooth.sum(1).tolist() == pytest.approx(accuracies(logits, images), abs=1e-7)
    assert not smooth[:, [4, 11]].any()


def test_its_derivative_is_that_of_central_differences(case, generator):
    logits, images = case
    rows = (images.labels[:, 0] != 2).nonzero()[
        :, 0
    ]  # a class without images is nan, and stays out of the mean
    logits, images, smooth = logits[rows].requires_grad_(), images.select(rows), SmoothAccuracy()

    def value(at):
        return smooth(DETECTOR, (at, torch.zeros(len(rows), 1, 4)), images).sum(1).nanmean()

    (slope,) = torch.autograd.grad(value(logits), logits)
    along = torch.randn(logits.shape, generator=generator, dtype=logits.dtype)
    at = logits.detach()
    difference = float(value(at + 1e-5 * along) - value(at - 1e-5 * along)) / 2e-5
    assert bool(slope.isfinite().all())
    assert float((slope * along).sum()) == pytest.approx(difference, rel=1e-8)

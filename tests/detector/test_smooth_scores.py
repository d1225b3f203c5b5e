"""Smooth scores against the scores themselves (counted by hand, COCO's, torchmetrics') and central differences."""

import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy
from torchvision.ops import batched_nms, box_iou

from neural_sim.detector.classifier import Classifier
from neural_sim.detector.metrics import AveragePrecision, evaluate, mean_of, of_document
from neural_sim.detector.protocol import Best
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Backbone
from neural_sim.detector.smooth_scores import (
    THRESHOLDS,
    Ranked,
    SmoothAccuracy,
    SmoothAP,
    nearest_box,
    overlap,
    ranked,
)
from neural_sim.types import LabelledImages

SHARP = SmoothAP(temperature=1e-6, width=1e-6)


def counted(found: Ranked) -> float:
    """AP without interpolation: the mean precision at the true positives, over thresholds; greedy as COCO matches."""
    order = found.logits.argsort(descending=True).tolist()
    total = 0.0
    for threshold in THRESHOLDS:
        taken, true = set(), 0
        for rank, i in enumerate(order, 1):
            box = int(found.box[i])
            if box >= 0 and box not in taken and float(found.overlaps[i]) > threshold:
                taken.add(box)
                true += 1
                total += true / rank
    return total / len(THRESHOLDS) / found.boxes


def some(generator: torch.Generator, images: int = 12, per_image: int = 3) -> Ranked:
    """Detections of images of which every third has no box, and the others one or two."""
    rows = []
    for image in range(images):
        boxes = [] if image % 3 == 0 else [2 * image, 2 * image + 1][: image % 3]
        logits = torch.randn(per_image, generator=generator, dtype=torch.float64).sort(descending=True).values
        for logit in logits:
            chosen = boxes[int(torch.randint(len(boxes), (), generator=generator))] if boxes else -1
            overlap_ = torch.rand((), generator=generator, dtype=torch.float64) * bool(boxes)
            rows.append((logit, overlap_, image, chosen))
    logits, overlaps, image, box = zip(*rows, strict=True)
    boxes = sum(image % 3 for image in range(images))
    return Ranked(torch.stack(logits), torch.stack(overlaps), torch.tensor(image), torch.tensor(box), boxes)


@pytest.mark.parametrize("seed", range(5))
def test_its_limit_is_ap_as_one_counts_it(seed):
    found = some(torch.Generator().manual_seed(seed))
    assert float(SHARP.of_class(found).sum()) == pytest.approx(counted(found), abs=1e-9)


def test_a_box_is_found_once_however_many_detections_it_has():
    found = Ranked(
        torch.tensor([3.0, 2.0, 1.0]), torch.tensor([0.8, 0.9, 0.9]), *[torch.zeros(3).long()] * 2, 1
    )
    true = SmoothAP().true_positives(found)
    assert bool((true.sum(0) <= 1.0 + 1e-6).all())
    # From 0.8 on the second is the true one, at 0.85; the first is then a false positive above it.
    assert float(SHARP.of_class(found).sum()) == pytest.approx((6 + 2 * 0.5 + 0.25) / 10, abs=0.06)


def test_false_positives_on_images_of_others_lower_it():
    own = Ranked(
        torch.tensor([1.0, -9.0]), torch.tensor([0.9, 0.0]), torch.arange(2), torch.tensor([0, -1]), 1
    )
    fooled = Ranked(torch.tensor([1.0, 1.5]), own.overlaps, own.image, own.box, 1)
    assert float(SmoothAP().of_class(fooled).sum()) < 0.6 * float(SmoothAP().of_class(own).sum())


def test_its_slope_is_that_of_central_differences():
    found = some(torch.Generator().manual_seed(3))
    smooth = SmoothAP(temperature=0.3, width=0.1)
    leaves = found.logits.clone().requires_grad_(), found.overlaps.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda a, b: smooth.of_class(Ranked(a, b, found.image, found.box, found.boxes)), leaves
    )


def test_no_boxes_is_refused_and_no_detections_is_zero():
    none = Ranked(torch.zeros(0), torch.zeros(0), torch.zeros(0).long(), torch.zeros(0).long(), 2)
    assert float(SmoothAP().of_class(none).sum()) == 0.0
    with pytest.raises(ValueError, match="at least one box"):
        SmoothAP().of_class(Ranked(none.logits, none.overlaps, none.image, none.box, 0))


def test_overlap_is_torchvisions():
    generator = torch.Generator().manual_seed(0)
    corners = torch.rand(2, 50, 2, generator=generator, dtype=torch.float64) * 20
    boxes = torch.cat([corners, corners + 1 + 10 * torch.rand(2, 50, 2, generator=generator)], -1)
    torch.testing.assert_close(overlap(boxes[0], boxes[1]), box_iou(boxes[0], boxes[1]).diagonal())


def test_a_detection_that_touches_no_box_still_has_one_of_its_class_as_the_nearest():
    """The image's first row is another class's box; a detection far from all boxes must not be matched to it."""
    boxes = torch.tensor([[40.0, 40, 50, 50], [0, 0, 10, 10], [70, 70, 80, 80]])
    truth = torch.tensor([[0.0, 0, 10, 10], [40, 40, 50, 50]]).expand(3, 2, 4)
    overlaps, which = nearest_box(boxes, truth, torch.tensor([[False, True]]).expand(3, 2))
    assert overlaps.tolist() == [1.0, 0.0, 0.0] and which.tolist() == [1, 1, 1]
    overlaps, which = nearest_box(boxes, truth, torch.zeros(3, 2, dtype=torch.bool))
    assert overlaps.tolist() == [0.0] * 3 and which.tolist() == [-1] * 3


def scattered(generator: torch.Generator, count: int) -> tuple[LabelledImages, Best, list[dict]]:
    """Images with no, one or two boxes of two classes; the same detections as the detector and as COCO sees them."""
    boxes, labels = torch.zeros(count, 2, 4), torch.full((count, 2), -1)
    rows, predictions = [], []
    for image in range(count):
        for place in range(image % 3):
            corner = torch.tensor([5.0 + 40 * place, 10.0]) + 5 * torch.rand(2, generator=generator)
            boxes[image, place] = torch.cat([corner, corner + 25])
            labels[image, place] = int(torch.randint(2, (), generator=generator))
        seen = []
        for label in range(2):
            near = [boxes[image, i] for i in range(2) if labels[image, i] == label]
            parts = [box + 3 * torch.randn(4, generator=generator) for box in near]
            parts += [torch.tensor([60.0, 60.0, 80.0, 80.0])]
            logits = torch.randn(len(parts), generator=generator) + torch.tensor([1.0] * len(near) + [0.0])
            for i in logits.argsort(descending=True).tolist():
                rows.append((image, label, logits[i], parts[i]))
                seen.append((label, logits[i].sigmoid(), parts[i]))
        predictions.append(
            {
                "labels": torch.tensor([row[0] for row in seen]),
                "scores": torch.stack([row[1] for row in seen]),
                "boxes": torch.stack([row[2] for row in seen]),
            }
        )
    image, label, logit, box = zip(*rows, strict=True)
    best = Best(torch.tensor(image), torch.tensor(label), torch.stack(logit), torch.stack(box))
    images = LabelledImages(torch.zeros(count, 3, 96, 96), boxes, labels, torch.zeros(count).long())
    return images, best, predictions


def test_it_is_coco_s_ap_but_for_the_interpolation():
    """COCO takes at each recall the best precision from there on: never lower, but for its 101 recalls."""
    images, best, predictions = scattered(torch.Generator().manual_seed(1), 150)

    class Given:
        def best(self, outputs, per_class):
            return best

    found = ranked(Given(), (torch.zeros(150, 1, 2), torch.zeros(150, 1, 4)), images, 5)
    coco = evaluate(predictions, images, ["a", "b"]).per_class
    for number, name in enumerate("ab"):
        ours = float(SHARP.of_class(found[number]).sum())
        assert ours == pytest.approx(coco[name], abs=0.03)
        assert ours < coco[name] + 0.01


def test_a_retinanet_s_best_are_its_predictions(tools, generator):
    detector, images = tools.detector(), tools.images(4)
    params = tools.noisy(detector.init(generator), generator)
    backbone, trainable = detector.split(params)
    outputs = detector.outputs(trainable, detector.features(backbone, images.images))
    best = detector.best(outputs, 100)
    wanted = detector.predict(params, images.images)
    for number, image in enumerate(wanted):
        for label in range(detector.num_classes):
            theirs = image["labels"] == label
            ours = (best.image == number) & (best.label == label)
            count = min(5, int(theirs.sum()))
            torch.testing.assert_close(best.logits[ours].sigmoid()[:count], image["scores"][theirs][:count])
            torch.testing.assert_close(best.boxes[ours][:count], image["boxes"][theirs][:count])
    one = detector.best(outputs, 1)
    assert len(one.image) <= 4 * detector.num_classes


def test_the_best_of_many_images_are_those_of_each_alone(generator, monkeypatch):
    """They are suppressed in blocks: the time of one call for all would grow with the square of their number."""
    detector, called = RetinaNet(3, 32, Backbone("micro")), []

    def counted(boxes, scores, group, iou):
        called.append(len(boxes))
        return batched_nms(boxes, scores, group, iou)

    monkeypatch.setattr("neural_sim.detector.protocol.batched_nms", counted)
    logits = torch.randn(25, len(detector.anchors), 3, generator=generator)
    code = 0.3 * torch.randn(25, len(detector.anchors), 4, generator=generator)
    together = detector.best((logits, code), 2)
    assert sum(called) == 25 * 100 and max(called) <= 1000
    for number in range(25):
        alone, own = detector.best((logits[[number]], code[[number]]), 2), together.image == number
        for part in ("label", "logits", "boxes"):
            assert torch.equal(getattr(together, part)[own], getattr(alone, part))


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

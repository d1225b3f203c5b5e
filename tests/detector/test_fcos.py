"""FCOS against torchvision's, and what the psi loop needs of it."""

import functools

import pytest
import torch
from torch import nn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.fcos import FCOS, FCOSHead
from torchvision.ops import generalized_box_iou_loss

from neural_sim.detector.fcos import Fcos, generalised_iou
from neural_sim.detector.losses import BACKGROUND
from neural_sim.detector.onnx_export import TOLERANCE
from neural_sim.detector.settings import Backbone, Detections, Head, Points
from neural_sim.detector.smooth_scores import SmoothAP
from neural_sim.detector.training import Optimisation, train_detector

SIZE = 64


def make_fcos(classes=3, size=SIZE, **settings):
    return Fcos(classes, size, **{"backbone": Backbone("micro"), "head": Head(8, 1), **settings})


class _Nothing(nn.Module):
    out_channels = 32


def reference(detector):
    """torchvision's own, for its assignment, loss and post-processing of given outputs."""
    anchors = AnchorGenerator(((8,), (16,)), ((1.0,),) * 2)
    wanted = detector.detections
    return FCOS(
        _Nothing(), detector.num_classes, anchor_generator=anchors, head=FCOSHead(32, 1, detector.num_classes),
        score_thresh=wanted.score_threshold, nms_thresh=wanted.nms_iou, topk_candidates=wanted.candidates,
    )  # fmt: skip


def cells(detector, count):
    """torchvision's anchors: squares of a stride's size about our points."""
    half = 0.5 * detector.strides[:, None]
    return [torch.cat([detector.points - half, detector.points + half], -1).double()] * count


def large_boxes(tools, count=5, scale=1):
    """Two boxes of 6 to 59 pixels an image, in images of 64, or of both ``scale`` times as large; the last has none."""
    images = tools.images(count)
    generator = torch.Generator().manual_seed(2)
    corner = torch.rand(count, 2, 2, generator=generator, dtype=torch.float64) * 20
    side = 6 + torch.rand(count, 2, 2, generator=generator, dtype=torch.float64) * 38
    side[:, 0] += 15
    pixels = torch.rand(count, 3, scale * SIZE, scale * SIZE, generator=generator, dtype=torch.float64)
    labels = torch.randint(0, 3, (count, 2), generator=generator)
    labels[-1] = -1
    return type(images)(pixels, scale * torch.cat([corner, corner + side], -1), labels, images.bins)


@pytest.mark.parametrize("activation", ["relu", "silu"])
def test_assignment_and_loss_are_torchvisions(tools, generator, activation):
    """torchvision's ranges are four to eight times an anchor's size, the first from 0 and the last without end."""
    detector = make_fcos(size=3 * SIZE, points=Points(limits=(64,), reference=None), activation=activation)
    params, images = tools.noisy(detector.init(generator), generator), large_boxes(tools, scale=3)
    backbone, trainable = detector.split(params)
    logits, code = detector.outputs(trainable, detector.features(backbone, images.images))
    targets = detector.assign(images.boxes, images.labels)
    losses, levels = detector.losses_of((logits, code), targets), detector.anchors_per_level
    assert all(bool((part >= 0).any()) for part in targets.labels.split(levels, 1))
    assert (targets.labels[-1] == BACKGROUND).all()
    for row in range(len(images)):
        kept = images.labels[row] >= 0
        truth = [{"boxes": images.boxes[row][kept], "labels": images.labels[row][kept]}]
        outputs = {
            "cls_logits": logits[row : row + 1], "bbox_regression": code[row : row + 1, :, :4],
            "bbox_ctrness": code[row : row + 1, :, 4:],
        }  # fmt: skip
        wanted = reference(detector).compute_loss(truth, outputs, cells(detector, 1), levels)
        # torchvision adds 1e-7 to areas in square pixels.
        torch.testing.assert_close(losses[row], sum(wanted.values()), rtol=1e-7, atol=0)


def test_a_point_finds_the_smallest_box_in_its_range_about_whose_centre_it_is():
    """By hand: a box of 40 about (32, 32) and one of 12 inside of it, of another class. The centre is the only point of
    the fine level in the small box. It is also the only point of either level that is near enough to all sides of the
    large box for the fine level."""
    detector = make_fcos(points=Points(limits=(24,), reference=None))
    boxes = torch.tensor([[[12.0, 12, 52, 52], [26, 26, 38, 38]]])
    targets = detector.assign(boxes, torch.tensor([[0, 1]]))
    places = detector.points.split(detector.anchors_per_level)
    found = [
        [{tuple(at.tolist()) for at in points[labels == label]} for label in (0, 1)]
        for points, labels in zip(places, targets.labels[0].split(detector.anchors_per_level), strict=True)
    ]
    around = {(float(x), float(y)) for x in (16, 32, 48) for y in (16, 32, 48)} - {(32.0, 32.0)}
    assert found == [[set(), {(32.0, 32.0)}], [around, set()]]
    (row,) = (targets.labels[0] == 1).nonzero()[:, 0].tolist()
    assert targets.deltas[0, row].tolist() == pytest.approx([0.75] * 4)


def test_a_distance_at_the_end_of_a_range_belongs_to_the_finer_level():
    """The farthest sides of boxes of whole pixels are often at such a distance; torchvision gives it to no level."""
    detector = make_fcos(size=96, points=Points(limits=(28,)))
    targets = detector.assign(torch.tensor([[[4.0, 20, 60, 28]]]), torch.tensor([[0]]))
    fine, coarse = ((part >= 0).sum() for part in targets.labels.split(detector.anchors_per_level, 1))
    assert (int(fine), int(coarse)) == (1, 0)


def test_generalised_iou_about_a_point_is_torchvisions():
    generator = torch.Generator().manual_seed(0)
    ours, theirs = (torch.rand(50, 4, generator=generator, dtype=torch.float64) + 0.01 for _ in range(2))
    boxes = [torch.cat([-part[:, :2], part[:, 2:]], -1) for part in (ours, theirs)]
    wanted = 1.0 - generalized_box_iou_loss(*boxes, eps=0.0)
    torch.testing.assert_close(generalised_iou(ours, theirs), wanted, rtol=1e-12, atol=1e-14)


def test_predict_is_torchvisions(tools, generator):
    detector = make_fcos(head=Head(8, 1, prior=0.3), detections=Detections(nms_iou=0.6))
    params, images = tools.noisy(detector.init(generator), generator), large_boxes(tools)
    backbone, trainable = detector.split(params)
    logits, code = detector.outputs(trainable, detector.features(backbone, images.images))
    levels, count = detector.anchors_per_level, len(images)
    split = {"cls_logits": logits, "bbox_regression": code[..., :4], "bbox_ctrness": code[..., 4:]}
    wanted = reference(detector).postprocess_detections(
        {name: list(value.split(levels, 1)) for name, value in split.items()},
        [list(part.split(levels)) for part in cells(detector, count)], [(SIZE, SIZE)] * count,
    )  # fmt: skip
    found = detector.predict(params, images.images, batch_size=2)
    assert any(len(image["scores"]) for image in found)
    for ours, theirs in zip(found, wanted, strict=True):
        assert torch.equal(ours["labels"], theirs["labels"])
        torch.testing.assert_close(ours["scores"], theirs["scores"], rtol=1e-10, atol=0)
        torch.testing.assert_close(ours["boxes"], theirs["boxes"], rtol=1e-10, atol=1e-10)


def test_hessian_products_are_central_differences_of_gradients(tools, generator):
    tools.check_hessian(make_fcos(), large_boxes(tools), generator, 1e-5, 1e-6)


def test_smooth_ap_falls_along_its_gradient(tools, generator):
    """Its derivative with respect to all outputs, against a central difference; centre-ness counts in the ranks."""
    detector, images, smooth = make_fcos(), large_boxes(tools), SmoothAP(width=0.3)
    backbone, trainable = detector.split(tools.noisy(detector.init(generator), generator))
    features = detector.features(backbone, images.images)
    logits, code = (part.detach().requires_grad_() for part in detector.outputs(trainable, features))
    objective = smooth(detector, (logits, code), images).nansum()
    slopes = torch.autograd.grad(objective, (logits, code))
    assert all(bool(slope.isfinite().all()) and bool(slope.any()) for slope in slopes)
    assert bool(slopes[1][..., 4].any())
    directions = [torch.randn(part.shape, generator=generator, dtype=part.dtype) for part in (logits, code)]

    def moved(h):
        outputs = tuple(part.detach() + h * d for part, d in zip((logits, code), directions, strict=True))
        return float(smooth(detector, outputs, images).nansum())

    along = sum(float((slope * d).sum()) for slope, d in zip(slopes, directions, strict=True))
    assert along == pytest.approx((moved(1e-7) - moved(-1e-7)) / 2e-7, rel=1e-5)


def test_scores_near_one_have_finite_logits():
    detector = make_fcos(1)
    logits, code = torch.full((1, 1, 1), 200.0), torch.full((1, 1, 5), 200.0, requires_grad=True)
    ranking = detector.ranking((logits, code))
    (slope,) = torch.autograd.grad(ranking.sum(), code)
    assert bool(ranking.isfinite().all()) and bool(slope.isfinite().all())
    low = detector.ranking((-logits, -code.detach()))
    torch.testing.assert_close(low, torch.full((1, 1, 1), -200.0))


def test_it_learns_to_find_a_box(tools):
    """A bright square on black, at sixteen places."""
    images = torch.zeros(16, 3, SIZE, SIZE)
    corners = torch.cartesian_prod(torch.arange(4), torch.arange(4)).float() * 10 + 4
    for image, (x, y) in zip(images, corners.int().tolist(), strict=True):
        image[:, y : y + 24, x : x + 24] = 1.0
    labelled = type(tools.images(1))(
        images,
        torch.cat([corners, corners + 24], -1)[:, None],
        torch.zeros(16, 1, dtype=torch.long),
        torch.zeros(16, dtype=torch.long),
    )
    detector = make_fcos(1, head=Head(16, 1))
    params = detector.init(torch.Generator().manual_seed(0))
    how = Optimisation(80, batch_size=8, learning_rate=1e-2)
    trained, history = train_detector(detector, params, labelled, torch.Generator().manual_seed(1), how)
    assert history.losses[-1] < 0.5 * history.losses[0]
    found = detector.predict(trained, images)
    near = sum(
        bool(len(each["boxes"])) and float((each["boxes"][0] - box[0]).abs().max()) < 4.0
        for each, box in zip(found, labelled.boxes, strict=True)
    )
    assert near >= 14


def test_strides_that_the_backbone_has_not_are_refused():
    with pytest.raises(ValueError, match=r"detector\.points\.strides: want an ascending choice of \(8, 16\)"):
        make_fcos(points=Points(strides=(4, 8)))


def test_labels_and_boxes_that_cannot_be_are_refused():
    detector, box = make_fcos(1), torch.tensor([[[1.0, 1, 5, 5]]])
    with pytest.raises(ValueError, match="want labels below 1, got 1"):
        detector.assign(box, torch.tensor([[1]]))
    with pytest.raises(ValueError, match="want boxes with x0 < x1"):
        detector.assign(box.flip(-1), torch.tensor([[0]]))


def test_a_model_file_and_onnx_give_the_same(tools, generator, tmp_path):
    make = functools.partial(tools.configured("fcos"), backbone=Backbone("micro"), head=Head(8, 1, prior=0.3))
    _, difference = tools.check_model_files(make, ("can", "mug"), tmp_path, generator)
    assert 0.0 < difference <= TOLERANCE

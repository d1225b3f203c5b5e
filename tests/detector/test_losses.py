"""Anchors' targets against torchvision's matcher; losses against torchvision's and closed forms."""

import pytest
import torch
from torchvision.models.detection._utils import BoxCoder, Matcher
from torchvision.ops import box_iou, sigmoid_focal_loss

from neural_sim.detector.losses import BACKGROUND, box_loss, focal_loss


def test_assign_is_torchvisions_matcher_image_by_image(tools):
    detector = tools.detector(image_size=96, anchors={"sizes": ((16, 24), (40, 64)), "reference": 96})
    generator = torch.Generator().manual_seed(3)
    corner = torch.rand(40, 3, 2, generator=generator, dtype=torch.float64) * 60
    boxes = torch.cat([corner, corner + 5 + torch.rand(40, 3, 2, generator=generator).double() * 30], dim=-1)
    labels = torch.randint(0, 3, (40, 3), generator=generator)
    labels[:10, 2] = -1
    labels[:4] = -1
    targets = detector.assign(boxes, labels)
    anchors, matcher = detector.anchors.double(), Matcher(0.5, 0.4, allow_low_quality_matches=True)
    seen = set()
    for image in range(40):
        kept = labels[image] >= 0
        if not kept.any():
            assert (targets.labels[image] == BACKGROUND).all()
            continue
        match = matcher(box_iou(boxes[image][kept], anchors))
        wanted = torch.where(match >= 0, labels[image][kept][match.clamp(min=0)], match)
        assert torch.equal(targets.labels[image], wanted)
        seen |= set(match.sign().tolist()) | {int(match.min())}
        foreground = match >= 0
        code = BoxCoder((1.0,) * 4).encode_single(boxes[image][kept][match[foreground]], anchors[foreground])
        torch.testing.assert_close(targets.deltas[image][foreground], code, rtol=1e-12, atol=1e-13)
        assert (targets.deltas[image][~foreground] == 0).all()
    assert {-2, -1, 1} <= seen


def test_images_without_boxes_and_without_rows(tools, images):
    detector = tools.detector()
    targets = detector.assign(images.boxes, images.labels)
    assert (targets.labels[-1] == BACKGROUND).all()
    assert (targets.labels[0] >= 0).any()
    none = detector.assign(torch.zeros(2, 0, 4), torch.zeros(2, 0, dtype=torch.long))
    assert none.labels.shape == (2, len(detector.anchors))
    assert (none.labels == BACKGROUND).all()


def test_deltas_carry_the_boxes_gradient(tools, images):
    boxes = images.boxes.clone().requires_grad_()
    deltas = tools.detector().assign(boxes, images.labels).deltas
    (gradient,) = torch.autograd.grad(deltas.sum(), boxes)
    assert torch.isfinite(gradient).all()
    assert (gradient[0, 0] != 0).any()
    assert (gradient[images.labels < 0] == 0).all()


def test_bad_boxes_and_labels_are_refused(tools):
    detector = tools.detector()
    with pytest.raises(ValueError, match=r"x0 < x1"):
        detector.assign(torch.tensor([[[4.0, 4.0, 4.0, 9.0]]]), torch.tensor([[0]]))
    with pytest.raises(ValueError, match="below 3, got 3"):
        detector.assign(torch.tensor([[[4.0, 4.0, 8.0, 9.0]]]), torch.tensor([[3]]))


def test_focal_loss_is_torchvisions(generator):
    logits = 6 * torch.randn(200, generator=generator, dtype=torch.float64)
    wanted = (torch.rand(200, generator=generator) < 0.3).double()
    torch.testing.assert_close(
        focal_loss(logits, wanted, 0.25, 2.0),
        sigmoid_focal_loss(logits, wanted, 0.25, 2.0),
        rtol=1e-12,
        atol=1e-14,
    )


@pytest.mark.parametrize("gamma", [0.5, 1.5])
def test_derivatives_with_a_fractional_gamma_are_finite_far_out(gamma):
    """The probability of a miss rounds to 0 there, where a power of it has an infinite derivative."""
    logits = torch.tensor([-200.0, 200.0, 0.3], requires_grad=True)
    wanted = torch.tensor([0.0, 1.0, 1.0])
    loss = focal_loss(logits, wanted, 0.25, gamma)
    torch.testing.assert_close(loss, sigmoid_focal_loss(logits, wanted, 0.25, gamma))
    (slope,) = torch.autograd.grad(loss.sum(), logits, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), logits)
    assert bool(slope.isfinite().all()) and bool(bend.isfinite().all())


def test_focal_loss_is_finite_far_out():
    logits = torch.tensor([-1e4, 1e4, -1e4, 1e4], dtype=torch.float64, requires_grad=True)
    wanted = torch.tensor([0.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    loss = focal_loss(logits, wanted, 0.25, 2.0)
    torch.testing.assert_close(loss, torch.tensor([0.0, 0.0, 2500.0, 7500.0], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(loss.sum(), logits)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("wanted", [0.0, 1.0])
def test_focal_loss_has_two_derivatives(wanted):
    logits = torch.linspace(-5, 5, 11, dtype=torch.float64, requires_grad=True)
    targets = torch.full_like(logits, wanted)
    assert torch.autograd.gradgradcheck(
        lambda z: focal_loss(z, targets, 0.25, 2.0), (logits,), check_fwd_over_rev=True
    )


def test_pseudo_huber_meets_its_limits():
    small = torch.tensor([1e-5, -1e-5], dtype=torch.float64)
    torch.testing.assert_close(box_loss(small, "pseudo_huber", 0.1), small**2 / 0.2, rtol=1e-6, atol=1e-14)
    large = torch.tensor([50.0, -50.0], dtype=torch.float64)
    gap = large.abs() - box_loss(large, "pseudo_huber", 0.1)
    torch.testing.assert_close(gap, torch.full_like(gap, 0.1), rtol=2e-3, atol=0)
    torch.testing.assert_close(box_loss(large, "l1", 0.1), large.abs())


def test_pseudo_huber_keeps_its_digits_in_float32():
    residual = torch.logspace(-6, 2, 33)
    exact = 0.1 * (torch.sqrt(1 + (residual.double() / 0.1) ** 2) - 1)
    torch.testing.assert_close(box_loss(residual, "pseudo_huber", 0.1).double(), exact, rtol=2e-6, atol=0)


def test_pseudo_huber_has_two_derivatives():
    residual = torch.tensor([-2.0, -0.05, 0.0, 0.05, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(
        lambda r: box_loss(r, "pseudo_huber", 0.1), (residual,), check_fwd_over_rev=True
    )

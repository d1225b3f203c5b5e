import pytest
import torch
from torchvision.ops import sigmoid_focal_loss

from neural_sim.detector.losses import box_loss, focal_loss


def test_focal_loss_is_torchvisions(generator):
    logits = 6 * torch.randn(200, generator=generator, dtype=torch.float64)
    wanted = (torch.rand(200, generator=generator) < 0.3).double()
    torch.testing.assert_close(
        focal_loss(logits, wanted, 0.25, 2.0),
        sigmoid_focal_loss(logits, wanted, 0.25, 2.0),
        rtol=1e-12,
        atol=1e-14,
    )


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

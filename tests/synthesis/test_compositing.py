import pytest
import torch

from neural_sim.synthesis.compositing import apply_shift, composite, draw_shift


def test_composite_of_hand_made_pixels() -> None:
    rgb = torch.tensor([[[[0.2, 0.1, 0.0], [0.0, 0.0, 0.0], [0.9, 0.8, 0.7]]]], dtype=torch.float64)
    opacity = torch.tensor([[[0.5, 0.0, 1.0]]], dtype=torch.float64)
    background = torch.full((1, 3, 1, 3), 0.4, dtype=torch.float64)
    got = composite(rgb, opacity, background)
    want = torch.tensor([[0.4, 0.4, 0.9], [0.3, 0.4, 0.8], [0.2, 0.4, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(got[0, :, 0], want)


def test_composite_refuses_channels_in_the_wrong_place() -> None:
    with pytest.raises(ValueError, match=r"got \(2, 3, 4, 4\)"):
        composite(torch.zeros(2, 3, 4, 4), torch.zeros(2, 4, 4), torch.zeros(2, 3, 4, 4))


def test_shift_equals_slicing() -> None:
    image = torch.rand(3, 5, 7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    shifted = apply_shift(image, torch.tensor([[2, -1], [0, 0], [-3, 4]]))
    want = torch.zeros_like(image)
    want[0, :-1, 2:] = image[0, 1:, :-2]
    want[1] = image[1]
    want[2, 4:, :-3] = image[2, :-4, 3:]
    assert torch.equal(shifted, want)


def test_shift_and_back_returns_what_stayed_inside() -> None:
    image = torch.zeros(1, 8, 8)
    image[:, 3:5, 3:5] = torch.rand(2, 2, generator=torch.Generator().manual_seed(2))
    shift = torch.tensor([[3, -3]])
    assert torch.equal(apply_shift(apply_shift(image, shift), -shift), image)


def test_shift_out_of_frame_is_zero_even_beside_a_nan() -> None:
    image = torch.full((1, 4, 4), torch.nan)
    assert torch.equal(apply_shift(image, torch.tensor([[4, 0]])), torch.zeros(1, 4, 4))
    assert torch.equal(apply_shift(image, torch.tensor([[0, -9]])), torch.zeros(1, 4, 4))


def test_the_derivative_of_a_shift_is_the_opposite_shift() -> None:
    """<shift(x), y> = <x, unshift(y)>: shifting is linear, and its adjoint is known."""
    generator = torch.Generator().manual_seed(3)
    x, y = torch.rand(2, 4, 6, 5, generator=generator, dtype=torch.float64)
    shift = torch.tensor([[1, 2], [-2, 0], [4, -5], [0, 1]])
    leaf = x.clone().requires_grad_()
    (got,) = torch.autograd.grad(apply_shift(leaf, shift), leaf, y)
    assert torch.equal(got, apply_shift(y, -shift))


def test_drawn_shifts_are_uniform_over_the_whole_range() -> None:
    shift = draw_shift(20000, 0.1, 20, 30, torch.Generator().manual_seed(4))
    for axis, reach in ((0, 3), (1, 2)):
        counts = torch.bincount(shift[:, axis] + reach, minlength=2 * reach + 1)
        assert len(counts) == 2 * reach + 1
        expected = 20000 / len(counts)
        assert ((counts - expected).abs() < 5 * expected**0.5).all()
    assert not draw_shift(100, 0.0, 20, 30, torch.Generator()).any()


def test_shift_fraction_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\].*got 1.5"):
        draw_shift(1, 1.5, 8, 8, torch.Generator())

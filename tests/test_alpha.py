import torch

from neural_sim.alpha import over_white, premultiplied


def test_colours_are_those_of_a_layer_over_white():
    rgba = torch.rand(2, 3, 4, 4, dtype=torch.float64)

    shown = over_white(premultiplied(rgba))

    for pixel, colour in zip(rgba.reshape(-1, 4), shown.reshape(-1, 3), strict=True):
        red, green, blue, alpha = pixel.tolist()
        torch.testing.assert_close(
            colour.tolist(), [c * alpha + (1.0 - alpha) for c in (red, green, blue)], atol=1e-15, rtol=0.0
        )


def test_clear_pixels_have_no_colour_and_alpha_stays():
    rgba = torch.tensor([[0.3, 0.6, 0.9, 0.0], [0.2, 0.4, 0.8, 0.5]])

    assert premultiplied(rgba).tolist() == torch.tensor([[0, 0, 0, 0], [0.1, 0.2, 0.4, 0.5]]).tolist()

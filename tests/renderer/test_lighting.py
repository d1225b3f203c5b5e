"""Lights: Lambert's law is linear in them, temperatures have the colours of black bodies, nonsense is refused."""

import numpy as np
import pytest

from neural_sim.renderer.lighting import Light, Lighting, lambert, temperature_colour


def unit(generator, count):
    vectors = generator.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_shade_is_linear_in_the_lights():
    generator = np.random.default_rng(0)
    normals, directions = unit(generator, 40), unit(generator, 3)
    colours = generator.uniform(size=(3, 3))
    lights = [Light(tuple(d), 1.0, tuple(c), 0.25) for d, c in zip(directions, colours, strict=True)]
    weights = [0.5, 0.2, 0.3]
    mixed = Lighting(
        tuple(Light(x.direction, w, x.colour, x.fill) for w, x in zip(weights, lights, strict=True)), 0.1
    )
    alone = [lambert(normals, Lighting((light,), 0.0)) for light in lights]
    expected = 0.1 + sum(w * shade for w, shade in zip(weights, alone, strict=True))
    np.testing.assert_allclose(lambert(normals, mixed), expected, rtol=0, atol=1e-14)


def test_fill_comes_from_all_sides_and_colours_it():
    light = Light((0.0, 0.0, 2.0), 0.8, (1.0, 0.5, 0.25), fill=0.25)
    shade = lambert(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), Lighting((light,), 0.1))
    colour = np.array([1.0, 0.5, 0.25])
    np.testing.assert_allclose(shade, [0.1 + 0.8 * colour, 0.1 + 0.2 * colour])


def test_a_light_that_takes_away_leaves_no_negative_shade():
    light = Light((0.0, 0.0, 1.0), -0.5)
    assert lambert(np.array([[0.0, 0.0, 1.0]]), Lighting((light,), 0.2)).min() == 0.0


def planckian_locus(kelvin):
    """Linear sRGB, largest channel 1, by the cubic fit of Kim et al. (US patent 7024034) to CIE x and y."""
    t = 1e3 / kelvin
    if kelvin <= 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = np.array([x / y, 1.0, (1.0 - x - y) / y])
    linear = (
        np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]) @ xyz
    )
    return linear / linear.max()


@pytest.mark.parametrize("kelvin", [2700.0, 3500.0, 5000.0, 6504.0, 9000.0])
def test_temperatures_have_the_colour_of_the_planckian_locus(kelvin):
    encoded = np.array(temperature_colour(kelvin))
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    # Both fit the tabulated observer: Wyman's lobes to about 1 % of its peak, Kim's cubics to 1e-3 in x and y.
    np.testing.assert_allclose(linear, planckian_locus(kelvin), atol=0.02)


def test_warm_light_is_red_and_cold_light_blue():
    warm, neutral, cold = (temperature_colour(kelvin) for kelvin in (2700.0, 6600.0, 12000.0))
    assert warm[0] > warm[1] > warm[2] and cold[2] > cold[1] > cold[0]
    assert min(neutral) > 0.95

"""The way between two lights: its ends, its geometry, and the figure."""

import math

import pytest
import torch

from neural_sim import cameras
from neural_sim.field.appearance import AppearanceField
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.report import tracking
from neural_sim.report.figures import save
from neural_sim.studies.illumination_interpolation import interpolate, interpolation_figure, publish
from neural_sim.types import PinholeCamera

CAMERA = PinholeCamera(12, 12, math.radians(40.0))
POSE = cameras.orbit(*torch.tensor([1.0, 0.5, 3.0]))


@pytest.fixture
def field(generator):
    torch.manual_seed(0)
    field = AppearanceField(features=4, head_width=8, code_size=4)
    field.grid.reset(torch.rand(6, 6, 6, generator=generator) < 0.5, torch.full((3,), -0.6), 0.2)
    field.reset_codes(torch.eye(3), generator)
    with torch.no_grad():
        field.grid.table[:-1] = torch.randn(field.grid.table[:-1].shape, generator=generator)
        field.codes.copy_(torch.randn(3, 4, generator=generator))
    return field.eval().requires_grad_(False)


def test_the_way_begins_and_ends_with_its_lights_and_keeps_the_geometry(field):
    ends, renderer = (torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])), NerfWRenderer()
    way = interpolate(field, renderer, CAMERA, POSE, ends, 5)
    assert way.images.shape == (5, 12, 12, 3) and way.opacity_change == 0.0
    for image, weights in ((way.images[0], ends[0]), (way.images[-1], ends[1])):
        rgb, opacity = renderer.render(field, CAMERA, POSE[None], weights=weights[None])
        torch.testing.assert_close(image, (rgb[0] + 1.0 - opacity[0, ..., None]).clamp(0.0, 1.0))
    moved = (way.images.diff(dim=0)).abs().amax((1, 2, 3))
    assert (moved > 1e-3).all() and moved.max() < 0.6 * (way.images[-1] - way.images[0]).abs().max()


def test_geometry_that_follows_the_light_is_refused(field):
    class Leaky(NerfWRenderer):
        def render(self, field, camera, camera_to_world, exact=False, weights=None):
            rgb, opacity = super().render(field, camera, camera_to_world, exact, weights)
            return rgb, opacity * (1.0 - 1e-4 * weights[:, :1, None])

    with pytest.raises(RuntimeError, match="opacity"):
        interpolate(field, Leaky(), CAMERA, POSE, (torch.eye(3)[0], torch.eye(3)[1]))


def test_the_figure_has_a_row_for_each_object(field, tmp_path):
    ends = (torch.eye(3)[0], torch.eye(3)[1])
    way = interpolate(field, NerfWRenderer(), CAMERA, POSE, ends, 4)
    figure = interpolation_figure({"drill": way, "052_extra_large_clamp": way}, "Between two lights")
    axes = figure.axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["drill", "052_extra_large_clamp"]
    assert axes.images[0].get_array().shape == (24, 48, 3)
    figure.draw_without_rendering()
    assert all(label.get_window_extent().x0 >= 0.0 for label in axes.get_yticklabels())
    assert save(figure, tmp_path / "way.png").stat().st_size > 1000


def test_the_report_says_how_much_opacity_and_colour_change(field, context):
    way = interpolate(field, NerfWRenderer(), CAMERA, POSE, (torch.eye(3)[0], torch.eye(3)[1]), 4)
    publish(context, {"drill": way}, "Between two lights")
    colour = float((way.images[-1] - way.images[0]).abs().mean())
    text = (context.folder / "interpolation.md").read_text()
    assert text.endswith(f"| drill | 0e+00 | {colour:.3f} |\n")
    assert (context.folder / "figures" / "interpolation.png").stat().st_size > 1000
    (run,) = tracking.logged_runs(context.uri, "study")
    assert run.name == "seed 4" and "interpolation.json" in run.files

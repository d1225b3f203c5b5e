"""`renderer` swaps the whole chain: lights of the views, kind of field, and renderer."""

import pytest
import torch
from composing import composed

from neural_sim.field.appearance import AppearanceField
from neural_sim.field.appearance_fitting import AppearanceFitting
from neural_sim.field.grid import GridField
from neural_sim.main import UserError, build
from neural_sim.renderer.nerf_w import NerfWRenderer


def experiment(*overrides):
    return build(composed(*overrides))


def test_nerf_w_brings_varied_light_and_fields_with_codes():
    made = experiment("renderer=nerf_w", "scale=smoke", "views.lights.rig.anchors=4")
    assert isinstance(made.imaging.renderer, NerfWRenderer)
    assert made.imaging.views.lights is not None and made.imaging.views.lights.rig.anchors == 4
    fitting = made.imaging.field.fitting(made.imaging.field.field())
    assert isinstance(fitting, AppearanceFitting) and isinstance(fitting.field, AppearanceField)
    assert fitting.grid.resolution == 64  # the scale's
    weights = made.imaging.views.lights.weights(made.imaging.views.count, torch.Generator())
    assert ((weights == 1.0).sum(0) >= 2).all()


def test_views_too_few_for_the_anchors_are_refused():
    with pytest.raises(UserError, match="12 anchors"):
        experiment("renderer=nerf_w", "scale=smoke", "views.lights.rig.anchors=12")


def test_without_it_no_light_varies_and_no_field_has_codes():
    made = experiment()
    assert made.imaging.views.lights is None and isinstance(made.imaging.field.field(), GridField)
    assert not isinstance(made.imaging.renderer, NerfWRenderer)

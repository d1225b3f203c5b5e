"""Ranges of the renderer's settings across several of them, and of classes that conf/ does not make."""

import math

import pytest

from neural_sim.renderer.lighting import Light, Lighting, temperature_colour
from neural_sim.renderer.pose_refinement import PoseRefinement
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.views import choose_mesh_renderer

CASES = [
    (LightRig, {"ambient": 0.3}, "LightRig.ambient: want at most 1 together with the largest intensity, 0.9"),
    (Light, {"direction": (0.0, 0.0, 0.0), "intensity": 1.0}, "Light.direction: want three numbers, not all of"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": math.nan}, "Light.intensity: want a finite number, got nan"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": 1.0, "colour": (1.2, 0.0, 0.0)}, "Light.colour[0]: want"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": 1.0, "fill": 1.5}, "Light.fill: want at least 0"),
    (Lighting, {"ambient": -0.1}, "Lighting.ambient: want at least 0"),
    (temperature_colour, {"kelvin": 300.0}, "temperature_colour.kelvin: want at least 1500.0 and at most 40000.0"),
    (PoseRefinement, {"resolution": 48}, "PoseRefinement.resolution: want a power of two of at least 32, got 48"),
    (RaycastRenderer, {"supersample": 0}, "RaycastRenderer.supersample: want at least 1"),
    (choose_mesh_renderer, {"backend": "blender"}, "views.backend: want one of auto, pyrender, raycast"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)

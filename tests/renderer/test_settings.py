"""The renderer's settings have ranges, and a value out of one is refused by its key."""

import math

import pytest

from neural_sim.renderer.lighting import Light, Lighting, temperature_colour
from neural_sim.renderer.nerf import NerfRenderer
from neural_sim.renderer.pose_refinement import PoseRefinement
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.rig import LightRig, VariedLight
from neural_sim.renderer.views import Views, choose_mesh_renderer

CASES = [
    (LightRig, {"anchors": 1}, "LightRig.anchors: want at least 2, got 1"),
    (LightRig, {"temperature_range": (100.0, 9000.0)}, "LightRig.temperature_range[0]: want at least 1500.0"),
    (LightRig, {"temperature_range": (9000.0, 2700.0)}, "LightRig.temperature_range: want values that do not decrease"),
    (LightRig, {"intensity_range": (0.0, 0.9)}, "LightRig.intensity_range[0]: want more than 0"),
    (LightRig, {"fill": 1.5}, "LightRig.fill: want at least 0 and at most 1, got 1.5"),
    (LightRig, {"ambient": 0.3}, "LightRig.ambient: want at most 1 together with the largest intensity, 0.9"),
    (VariedLight, {"anchored": 0.0}, "VariedLight.anchored: want more than 0 and at most 1"),
    (VariedLight, {"mixtures": 0}, "VariedLight.mixtures: want at least 1"),
    (Light, {"direction": (0.0, 0.0, 0.0), "intensity": 1.0}, "Light.direction: want three numbers, not all of"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": math.nan}, "Light.intensity: want a finite number, got nan"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": 1.0, "colour": (1.2, 0.0, 0.0)}, "Light.colour[0]: want"),
    (Light, {"direction": (0.0, 0.0, 1.0), "intensity": 1.0, "fill": 1.5}, "Light.fill: want at least 0"),
    (Lighting, {"ambient": -0.1}, "Lighting.ambient: want at least 0"),
    (temperature_colour, {"kelvin": 300.0}, "temperature_colour.kelvin: want at least 1500.0 and at most 40000.0"),
    (NerfRenderer, {"rays_per_chunk": 0}, "NerfRenderer.rays_per_chunk: want at least 1"),
    (NerfRenderer, {"step": 0.0}, "NerfRenderer.step: want more than 0, got 0.0"),
    (NerfRenderer, {"termination": 1.0}, "NerfRenderer.termination: want at least 0 and less than 1, got 1.0"),
    (PoseRefinement, {"rounds": -1}, "PoseRefinement.rounds: want at least 0"),
    (PoseRefinement, {"updates": 0}, "PoseRefinement.updates: want at least 1, got 0"),
    (PoseRefinement, {"image_size": 4}, "PoseRefinement.image_size: want at least 8"),
    (PoseRefinement, {"resolution": 48}, "PoseRefinement.resolution: want a power of two of at least 32, got 48"),
    (RaycastRenderer, {"supersample": 0}, "RaycastRenderer.supersample: want at least 1"),
    (choose_mesh_renderer, {"backend": "blender"}, "renderer.backend: want one of auto, pyrender, raycast"),
    (Views, {"backend": "blender"}, "Views.backend: want one of auto, pyrender, raycast, got 'blender'"),
    (Views, {"distance_range": (0.9, 4.0)}, "Views.distance_range[0]: want more than 1, got 0.9"),
    (Views, {"distance_range": (4.0, 2.4)}, "Views.distance_range: want values that do not decrease"),
    (Views, {"distance_range": (math.inf, math.inf)}, "Views.distance_range[0]: want more than 1 and finite, got inf"),
    (Views, {"field_of_view_deg": 180.0}, "Views.field_of_view_deg: want more than 0 and less than 180"),
    (Views, {"count": 0}, "Views.count: want at least 1"),
    (Views, {"seed": -1}, "Views.seed: want at least 0"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "values", "message"), CASES)
def test_settings_out_of_range_are_refused(make, values, message):
    with pytest.raises(ValueError) as caught:
        make(**values)
    assert str(caught.value).startswith(message)

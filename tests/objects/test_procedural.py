"""The six embedded objects: closed, reproducible, different in every bin, alike where they should be."""

import math

import numpy as np
import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.objects.procedural import DESIGNS, Procedural
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.types import PinholeCamera

NAMES = ["can", "pitcher", "tall_box", "flat_box", "mug", "drill"]


@pytest.fixture(scope="module")
def objects():
    return {item.name: item for item in Procedural().load()}


@pytest.fixture(scope="module")
def bin_views(objects):
    """Opaque-over-grey views [8, 48, 48, 3] and masks from the middle of each of the eight pose bins."""
    camera = PinholeCamera(48, 48, math.radians(40.0))
    phi = torch.deg2rad(22.5 + 45.0 * torch.arange(8, dtype=torch.float64))
    poses = orbit(phi, torch.zeros(8, dtype=torch.float64), torch.full((8,), 3.0, dtype=torch.float64))
    renderer = RaycastRenderer(supersample=2)
    views = {}
    for name, item in objects.items():
        rgba = renderer.render(item.mesh, camera, poses)
        alpha = rgba[..., 3:]
        views[name] = (rgba[..., :3] * alpha + 0.5 * (1.0 - alpha), alpha[..., 0] > 0.5)
    return views


def test_the_six_are_normalised_closed_and_light(objects):
    assert list(objects) == NAMES == list(DESIGNS)
    for name, item in objects.items():
        norms = np.linalg.norm(item.mesh.vertices, axis=1)
        assert norms.max() == pytest.approx(1.0), name
        np.testing.assert_allclose(item.mesh.bounds.sum(0), 0.0, atol=1e-9)
        assert len(item.mesh.faces) < 20_000
        seamless = item.mesh.copy()
        seamless.merge_vertices(merge_tex=True, merge_norm=True)
        assert seamless.is_watertight and seamless.is_winding_consistent, name
        for part in seamless.split(only_watertight=True):
            assert part.volume > 0.0, f"{name}: a part's normals point inward"


def test_same_seed_same_bytes_and_independent_of_the_others(objects):
    alone = Procedural(["drill"]).load()[0]
    assert alone.digest == objects["drill"].digest
    assert Procedural(["drill"], seed=1).load()[0].digest != alone.digest
    assert Procedural().digests() == {name: item.digest for name, item in objects.items()}


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"can, pitcher.*got \['kettle'\]"):
        Procedural(["kettle"])
    with pytest.raises(ValueError, match=r"Procedural\.seed: want at least 0, got -1"):
        Procedural(seed=-1)
    with pytest.raises(
        ValueError, match=r"Procedural\.names: want 1 or more values and no repeated value or null"
    ):
        Procedural(["can", "can"])


def test_every_bin_of_every_object_renders_differently(bin_views):
    for name, (images, _) in bin_views.items():
        for i in range(8):
            for j in range(i):
                difference = (images[i] - images[j]).abs().mean().item()
                assert difference > 0.01, f"{name}: bins {j + 1} and {i + 1} look the same ({difference:.4f})"


def _cropped(views, name, bins):
    """The object's bounding boxes, resized to 24 x 24: what is left once place and distance are taken out."""
    crops = []
    for index in bins:
        image, mask = views[name][0][index], views[name][1][index]
        rows, columns = mask.any(1).nonzero().flatten(), mask.any(0).nonzero().flatten()
        crop = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].permute(2, 0, 1)[None]
        crops.append(torch.nn.functional.interpolate(crop, size=(24, 24), mode="area")[0])
    return torch.stack(crops)


@pytest.mark.parametrize(
    ("name", "double", "bins"), [("pitcher", "can", [1, 2]), ("drill", "tall_box", [5, 6])]
)
def test_the_confusable_side_looks_more_like_another_object_than_like_the_rest_of_its_own(
    bin_views, name, double, bins
):
    for index in bins:
        (view,) = _cropped(bin_views, name, [index])
        distances = {
            (other, b): (crop - view).abs().mean().item()
            for other in bin_views
            for b, crop in enumerate(_cropped(bin_views, other, range(8)))
            if other != name or b not in bins
        }
        nearest = min(distances, key=lambda key: distances[key])
        assert nearest[0] == double, f"bin {index + 1} is nearest to bin {nearest[1] + 1} of {nearest[0]}"
        assert distances[nearest] > 0.01  # but not the same


def test_handle_and_chuck_are_hidden_from_the_other_side(objects):
    # Distinguishing parts must not peep out within rho = +-45 degrees, or the sides would not be confused.
    for name, towards, reach in (("pitcher", 1.0, objects["pitcher"]), ("drill", -1.0, objects["drill"])):
        vertices = reach.mesh.vertices * np.array([towards, 1.0, 1.0])
        behind = vertices[:, 0] < vertices[:, 0].min() + 0.05
        for rho in (-math.pi / 4, 0.0, math.pi / 4):
            across = np.array([-math.sin(rho), math.cos(rho), 0.0])
            lateral = vertices @ across
            assert np.abs(lateral[behind]).max() < np.abs(lateral[~behind]).max(), (name, rho)

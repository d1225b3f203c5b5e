"""Meshes of several materials in both renderers, against colours computed pixel by pixel."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from neural_sim.cameras import orbit
from neural_sim.objects.paint import Part, Texture, join
from neural_sim.objects.repair import repair
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.renderer.views import choose_mesh_renderer, opengl_platform
from neural_sim.types import PinholeCamera

UNLIT = Lighting((), ambient=1.0)
SIZE, DISTANCE = 96, 3.0
CAMERA = PinholeCamera(SIZE, SIZE, 2.0 * math.atan(1.0 / DISTANCE))
"""Sees the square of side 2 in the plane z = 0 and nothing else from ``DISTANCE``."""
FOUR = np.array([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 0]]], dtype=np.uint8)


@pytest.fixture(params=["raycast", "pyrender"])
def renderer(request):
    if request.param == "raycast":
        return RaycastRenderer(1, UNLIT)
    if opengl_platform() is None:
        pytest.skip("neither EGL nor OSMesa draws on this machine")
    return choose_mesh_renderer("pyrender", 1, UNLIT)


def half(
    left: float, right: float, texture: Texture | None, colour=(1.0, 1.0, 1.0), tiles: float = 1.0
) -> Part:
    """A part of the square z = 0 between two places of the picture, 0 at its left edge and 1 at its right one."""
    uv = np.array([[left, 0.0], [right, 0.0], [right, 1.0], [left, 1.0]])
    corners = np.stack([1.0 - 2.0 * uv[:, 1], 2.0 * uv[:, 0] - 1.0, 0.0 * uv[:, 0]], -1)
    moved = None if texture is None else tiles * uv - 0.5 * (tiles - 1.0)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Part(corners, faces, np.tile(np.array(colour), (4, 1)), None, moved, texture)


def drawn(renderer, parts: list[Part]) -> np.ndarray:
    pose = orbit(*(torch.tensor([value], dtype=torch.float64) for value in (0.0, 0.0, DISTANCE)))
    view = renderer.render(repair(join(parts), "square", "here"), CAMERA, pose)[0].numpy()
    assert (view[..., 3] == 1.0).all()
    return 255.0 * view[..., :3]


def texel(place: np.ndarray, size: int, wrap: str) -> np.ndarray:
    """The texel of a coordinate by the definition of OpenGL's wrapping modes."""
    index = np.floor(place * size).astype(int)
    if wrap == "repeat":
        return index - size * np.floor_divide(index, size)
    if wrap == "clamp":
        return np.minimum(np.maximum(index, 0), size - 1)
    folded = np.abs((place + 1.0) % 2.0 - 1.0)  # a triangle wave of period 2
    return np.minimum(np.floor(folded * size).astype(int), size - 1)


@pytest.mark.parametrize("wrap", [("repeat", "repeat"), ("mirror", "clamp"), ("clamp", "mirror")])
def test_each_material_is_drawn_with_its_own_tiles_and_tint(renderer, wrap):
    big = np.asarray(Image.fromarray(FOUR).resize((128, 128), Image.Resampling.NEAREST))
    plain = np.asarray(Image.new("RGB", (8, 8), (40, 200, 120)))
    parts = [
        half(0.0, 0.5, Texture(big, wrap), tiles=3.0),
        half(0.5, 0.75, Texture(plain), (0.5, 1.0, 0.25)),
        half(0.75, 1.0, None, (0.8, 0.2, 0.4)),
    ]
    seen = drawn(renderer, parts)
    u, v = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, 1.0 - (np.arange(SIZE) + 0.5) / SIZE)
    tiled = [3.0 * place - 1.0 for place in (u, v)]
    columns, rows = texel(tiled[0], 2, wrap[0]), 1 - texel(tiled[1], 2, wrap[1])
    wanted = FOUR[rows, columns].astype(float)
    wanted[:, SIZE // 2 :] = (20, 200, 30)
    wanted[:, 3 * SIZE // 4 :] = (204, 51, 102)
    # Away from edges between tiles and parts, where filters blend; the picture's own are edges of tiles.
    edge = np.ones((SIZE, SIZE), dtype=bool)
    edge[1:-1, 1:-1] = False
    for axis in (0, 1):
        step = np.abs(np.diff(wanted, axis=axis)).max(-1) > 0
        for side in (step, np.roll(step, 1, axis)):
            padded = np.zeros_like(edge)
            padded[tuple(slice(0, n) for n in side.shape)] = side
            edge |= padded | np.roll(padded, 1, axis) | np.roll(padded, -1, axis)
    assert (~edge).mean() > 0.5
    assert np.abs(seen - wanted)[~edge].max() < 3.0


def test_vertex_colours_multiply_a_texture_and_lie_beside_plain_ones(renderer):
    part = half(0.0, 0.5, Texture(np.full((4, 4, 3), 200, np.uint8)))
    ramp = np.array([[0.0, 1.0, 0.5], [1.0, 1.0, 0.5], [1.0, 1.0, 0.5], [0.0, 1.0, 0.5]])
    shaded = Part(part.vertices, part.faces, ramp, None, part.uv, part.texture)
    seen = drawn(renderer, [shaded, half(0.5, 1.0, None, (0.0, 0.0, 1.0))])
    across = 2.0 * (np.arange(SIZE // 2) + 0.5) / SIZE
    np.testing.assert_allclose(seen[SIZE // 2, : SIZE // 2, 0], 200.0 * across, atol=2.0)
    np.testing.assert_allclose(
        seen[:, : SIZE // 2 - 1, 1:], np.broadcast_to([200.0, 100.0], (96, 47, 2)), atol=2.0
    )
    np.testing.assert_allclose(
        seen[:, SIZE // 2 + 1 :], np.broadcast_to([0.0, 0.0, 255.0], (96, 47, 3)), atol=1.0
    )


def test_repair_keeps_the_paint_of_what_is_left(renderer, caplog):
    red, blue = half(0.0, 0.5, Texture(FOUR[:1, :1].copy())), half(0.5, 1.0, None, (0.0, 0.0, 1.0))
    broken = Part(
        np.concatenate([[[np.nan, 0.0, 0.0]], red.vertices]), np.concatenate([[[0, 1, 2]], red.faces + 1]),
        np.ones((5, 3)), None, np.concatenate([[[np.nan, 0.0]], red.uv]), red.texture,
    )  # fmt: skip
    seen = drawn(renderer, [broken, blue])
    assert seen[10, 10].tolist() == [250, 0, 0] and seen[10, 80].tolist() == [0, 0, 255]
    assert "dropped 1 of 5 faces" in caplog.text

"""Render meshes by ray casting on the CPU (trimesh over embree), for machines without OpenGL."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8
from PIL import Image
from torch import Tensor

from neural_sim.cameras import focal_lengths, rays
from neural_sim.objects.paint import Wrap
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.surface import Surface
from neural_sim.types import PinholeCamera

# Offsets from a pixel's centre in pixels, right and down: the usual rotated grid of OpenGL's 4x multisampling, which
# pyrender uses. With it, the silhouettes of both renderers agree to a sample.
EDGE_SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))


class RaycastRenderer(MeshRenderer):
    """Renders what ``PyrenderRenderer`` does, without OpenGL: embree casts rays, mipmaps filter textures."""

    name = "raycast"

    def _draw(
        self, surface: Surface, camera: PinholeCamera, poses: Float64[np.ndarray, "n 4 4"]
    ) -> Iterator[Float32[np.ndarray, "height width 4"]]:
        bare = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        pyramids = [Pyramid(texture.pixels, texture.wrap) for texture in surface.textures]
        for pose in torch.from_numpy(poses):
            yield _cast(bare, surface, pyramids, camera, pose)


def _cast(
    mesh: trimesh.Trimesh, surface: Surface, pyramids: Sequence[Pyramid], camera: PinholeCamera, pose: Tensor
) -> Float[np.ndarray, "h w 4"]:
    """Cast a ray through each pixel's centre, or four through a pixel on a silhouette; return premultiplied RGBA."""
    bundle = rays(camera, pose)
    origins, directions = bundle.origins.reshape(-1, 3).numpy(), bundle.directions.reshape(-1, 3).numpy()
    image = _trace(mesh, surface, pyramids, camera, origins, directions)
    edge = _silhouette(image[:, 3].reshape(camera.height, camera.width) > 0.0).reshape(-1)
    image[edge] = 0.0
    fx, fy = focal_lengths(camera)
    for x, y in EDGE_SAMPLES:
        shifted = _shifted(directions[edge], pose.numpy(), x / fx, y / fy)
        image[edge] += _trace(mesh, surface, pyramids, camera, origins[edge], shifted) / len(EDGE_SAMPLES)
    return image.reshape(camera.height, camera.width, 4)


def _trace(
    mesh: trimesh.Trimesh,
    surface: Surface,
    pyramids: Sequence[Pyramid],
    camera: PinholeCamera,
    origins: np.ndarray,
    directions: np.ndarray,
) -> Float[np.ndarray, "rays 4"]:
    image = np.zeros((len(origins), 4), dtype=np.float32)
    if len(origins) == 0:
        return image
    face = mesh.ray.intersects_first(origins, directions)
    hit = np.flatnonzero(face >= 0)
    if len(hit):
        image[hit, :3] = _colours(surface, pyramids, face[hit], origins[hit], directions[hit], camera)
        image[hit, 3] = 1.0
    return image


def _silhouette(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Find the pixels whose 3 x 3 neighbourhood has both hit and empty pixels."""
    padded = np.pad(mask, 1, mode="edge")
    height, width = mask.shape
    near = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
    return np.any(near, axis=0) & ~np.all(near, axis=0)


def _shifted(directions: np.ndarray, pose: np.ndarray, x: float, y: float) -> Float[np.ndarray, "rays 3"]:
    """Return unit directions moved by (x, y) on the image plane at distance 1, right and down."""
    right, up, backward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    on_plane = directions / -(directions @ backward)[:, None] + x * right - y * up
    return on_plane / np.linalg.norm(on_plane, axis=1, keepdims=True)


def _colours(
    surface: Surface,
    pyramids: Sequence[Pyramid],
    face: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    camera: PinholeCamera,
) -> Float[np.ndarray, "hits 3"]:
    corners = surface.faces[face]
    weights, distance, cosine, area = _barycentric(surface.vertices[corners], origins, directions)
    sides = np.where((cosine < 0.0)[:, None, None], surface.front[corners], surface.back[corners])
    # As in OpenGL, the product of albedo and shade is interpolated, not its factors.
    vertex_colour = surface.albedo[corners] * sides
    colour = np.einsum("nk,nkc->nc", weights, vertex_colour)
    uv = surface.uv[corners]
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    uv_area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    sample = distance / min(focal_lengths(camera))
    place = np.einsum("nk,nkc->nc", weights, uv)
    page = surface.page[face]
    for number, pyramid in enumerate(pyramids):
        on_page = page == number
        texels = uv_area[on_page] * pyramid.texels / np.maximum(area[on_page], 1e-12)
        # OpenGL's isotropic filter uses the longer side of the footprint, which a slanted face stretches.
        texels_a_side = np.sqrt(texels) * sample[on_page] / np.maximum(np.abs(cosine[on_page]), 0.05)
        colour[on_page] = colour[on_page] * pyramid.sample(place[on_page], np.log2(texels_a_side + 1e-12))
    return np.clip(colour, 0.0, 1.0)


def _barycentric(
    triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return each ray's weights [n, 3] on its triangle, distance, cosine (ray . outward normal) and area [n]."""
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(edge_1, edge_2)
    length = np.maximum(np.linalg.norm(normal, axis=-1), 1e-20)
    facing = np.einsum("nc,nc->n", normal, directions)
    facing = np.where(np.abs(facing) < 1e-20, 1e-20, facing)
    offset = triangles[:, 0] - origins
    distance = np.einsum("nc,nc->n", normal, offset) / facing
    inside = distance[:, None] * directions - offset
    w1 = np.einsum("nc,nc->n", np.cross(inside, edge_2), normal) / length**2
    w2 = np.einsum("nc,nc->n", np.cross(edge_1, inside), normal) / length**2
    weights = np.clip(np.stack([1.0 - w1 - w2, w1, w2], -1), 0.0, 1.0)
    weights = weights / weights.sum(-1, keepdims=True)
    return weights, distance, facing / length, 0.5 * length


class Pyramid:
    """A texture and its mipmaps, each half the size of the last; ``sample`` blends two neighbouring levels."""

    def __init__(
        self, texture: UInt8[np.ndarray, "h w 3"], wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    ) -> None:
        self._wrap = wrap
        height, width = texture.shape[:2]
        self.texels = height * width
        self._levels = [np.asarray(texture, dtype=np.uint8)]
        image = Image.fromarray(self._levels[0])
        while max(width, height) > 1:
            width, height = max(width // 2, 1), max(height // 2, 1)
            image = image.resize((width, height), Image.Resampling.BOX)
            self._levels.append(np.asarray(image))

    def sample(self, uv: Float[np.ndarray, "n 2"], level: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Sample colours in [0, 1]; ``uv`` has v upwards; ``level``: log2 of texels per sample (<= 0: full size)."""
        level = np.clip(level, 0.0, len(self._levels) - 1.0)
        low = np.floor(level).astype(np.int64)
        part = (level - low)[:, None]
        colour = np.zeros((len(uv), 3))
        for number in np.unique(np.concatenate([low, low + 1])):
            weight = np.where(
                low[:, None] == number, 1.0 - part, np.where(low[:, None] + 1 == number, part, 0.0)
            )
            rows = np.flatnonzero(weight[:, 0] > 0.0)
            if len(rows):
                colour[rows] += weight[rows] * _bilinear(self._levels[number], uv[rows], self._wrap)
        return colour / 255.0


def _bilinear(texture: np.ndarray, uv: np.ndarray, wrap: tuple[Wrap, Wrap]) -> np.ndarray:
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    left, right = _wrapped(x0, width, wrap[0]), _wrapped(x0 + 1, width, wrap[0])
    top, bottom = _wrapped(y0, height, wrap[1]), _wrapped(y0 + 1, height, wrap[1])
    upper = texture[top, left] * (1.0 - fx) + texture[top, right] * fx
    lower = texture[bottom, left] * (1.0 - fx) + texture[bottom, right] * fx
    return upper * (1.0 - fy) + lower * fy


def _wrapped(index: Int[np.ndarray, "n"], size: int, wrap: Wrap) -> Int[np.ndarray, "n"]:
    """Return texel indices, with those beyond the edges replaced by indices inside."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        turned = index % (2 * size)
        return np.minimum(turned, 2 * size - 1 - turned)
    return index % size

"""One image of an exported data set: drawn from its number alone, rendered with depth, composed, with its masks."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from neural_sim.cameras import cropped, focal_lengths, magnified, orbit, principal_point, turned
from neural_sim.synthesis.compositing import draw_shift
from neural_sim.synthesis.layout import draw_layout
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.sensor import seen_by
from neural_sim.types import PinholeCamera, SceneDraw

MASK_OPACITY = 0.5
"""Opacity above which a pixel belongs to an object. Depths are measured where a ray has lost this much of its light."""
GOLDEN, SILVER = 0.5 * (math.sqrt(5.0) - 1.0), math.sqrt(2.0) - 1.0
"""Steps that spread numbers evenly, however many there are, and independently of each other."""

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class DrawnObject:
    """An object's place in an image.

    ``draw`` are its scene parameters (one draw; distance in object radii); ``shift`` are the pixels (right, down) from
    the principal point to its centre; ``camera`` is the image's camera with the draw's magnification;
    ``camera_to_world`` is the camera's pose in the object's frame (float64, OpenGL axes, object radii). If two objects
    are equally distant, the one with the smaller ``order``, in [0, 1), is in front.
    """

    label: int
    draw: SceneDraw
    shift: tuple[int, int]
    camera: PinholeCamera
    camera_to_world: Float[Tensor, "4 4"]
    order: float


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object in an image.

    ``full`` are the pixels of its silhouette within the image, ``visible`` those that nothing hides; ``pixels`` counts
    those of its whole silhouette, also beyond the image, and ``box`` (x0, y0, x1, y1) surrounds them, None if there are
    none. ``labelled`` says whether enough of it is visible for a label.
    """

    placed: DrawnObject
    full: Bool[np.ndarray, "height width"]
    visible: Bool[np.ndarray, "height width"]
    pixels: int
    box: Box | None
    labelled: bool


@dataclass(frozen=True, eq=False)
class ExportImage:
    """An image, sRGB in 8 bits, with its depth and its objects, in the order of the layout.

    The depth is that of the visible surface along the view axis, in millimetres, and 0 where there is no object.
    """

    pixels: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    objects: tuple[ShownObject, ...]


def spread(number: int, fraction: float, step: float) -> bool:
    """Return whether a number belongs to a fraction of all numbers that is spread evenly over any range."""
    return (number + 1) * step % 1.0 < fraction


@dataclass(frozen=True)
class ImageSource:
    """Images by number. An image depends only on ``seed`` and its number, so that a set can grow.

    ``scene`` says how images are made; they are drawn from ``psi`` [objects, K]; ``camera`` has their size.
    ``millimetres`` is each object's radius. Image i's own class is i modulo the number of classes. The synthesizer's
    shift turns the camera (``cameras.turned``), so that every object has an exact pose under the image's one camera. A
    fraction ``empty`` of the images shows no object.
    """

    scene: Scene
    psi: Float[Tensor, "objects K"]
    camera: PinholeCamera
    millimetres: tuple[float, ...]
    seed: int
    empty: float = 0.0

    def generator(self, number: int, part: Literal["scene", "pixels"]) -> torch.Generator:
        """Return the generator of an image's scene parameters, or of its background and noise."""
        state = hashlib.sha256(f"{self.seed} {number} {part}".encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(state[:8], "little") >> 1)

    def drawn(self, number: int) -> list[DrawnObject]:
        """Draw the objects of an image, its own object first."""
        if spread(number, self.empty, SILVER):
            return []
        generator, scene, camera = self.generator(number, "scene"), self.scene, self.camera
        synthesizer, classes = scene.synthesizer, len(scene.names)
        layout = draw_layout(torch.tensor([number % classes]), classes, synthesizer.count, generator)
        placed = []
        for label, order in zip(layout.labels[0].tolist(), layout.order[0].tolist(), strict=True):
            noise = scene.distribution.draw_noise(1, generator, torch.float64)
            shift = draw_shift(1, synthesizer.shift, camera.height, camera.width, generator)[0].tolist()
            if label < 0:
                continue
            draw = scene.distribution.hard(self.psi[label].double(), noise)
            draw = replace(draw, distance=draw.distance / scene.radii[label])
            own = camera if draw.magnification is None else magnified(camera, float(draw.magnification))
            pose = turned(own, orbit(draw.phi, draw.rho, draw.distance)[0], (shift[0], shift[1]))
            placed.append(DrawnObject(label, draw, (shift[0], shift[1]), own, pose, order))
        return placed

    @torch.no_grad()
    def image(self, number: int) -> ExportImage:
        """Make the image with this number."""
        height, width, placed = self.camera.height, self.camera.width, self.drawn(number)
        device = self.scene.device
        layers = [self._layer(item) for item in placed]
        generator, synthesizer = self.generator(number, "pixels"), self.scene.synthesizer
        covers = synthesizer.distractors.draw(1, height, width, generator, device)
        clear, depth = torch.ones(height, width, device=device), torch.zeros(height, width, device=device)
        colour = torch.zeros(height, width, 3, device=device)
        if covers is not None:  # what is in front hides pixels, like an object without a mask
            clear, colour = 1.0 - covers[1].opacity[0], covers[1].rgb[0].clone()
        full = [torch.zeros(height, width, dtype=torch.bool, device=device) for _ in placed]
        visible = [torch.zeros_like(mask) for mask in full]

        def nearness(index: int) -> tuple[float, float]:
            item = placed[index]
            return float(item.draw.distance) * self.millimetres[item.label], item.order

        for index in sorted(range(len(placed)), key=nearness):
            layer = layers[index]
            inside, there = layer.within(height, width)
            rgb, opacity = layer.rgb[inside], layer.opacity[inside]
            shown = clear[there] * opacity
            colour[there] += clear[there][..., None] * rgb
            clear[there] -= shown
            full[index][there] = opacity > MASK_OPACITY
            visible[index][there] = shown > MASK_OPACITY
            millimetres = layer.depth[inside] * self.millimetres[placed[index].label]
            depth[there] = torch.where(shown > MASK_OPACITY, millimetres, depth[there])
        background = synthesizer.background.draw(1, height, width, generator, device)
        background = background if covers is None else covers[0].over(background)
        sensor = synthesizer.sensor.draw(1, height, width, generator, device)
        pixels = _developed(seen_by(colour.movedim(-1, 0)[None] + clear * background, sensor)[0])
        parts = zip(placed, layers, full, visible, strict=True)
        shown_objects = tuple(self._shown(item, layer, *masks) for item, layer, *masks in parts)
        return ExportImage(pixels, depth.cpu().numpy(), shown_objects)

    def _layer(self, item: DrawnObject) -> Layer:
        """Render one object alone, on the part of the image plane that it may cover."""
        subject = self.scene.fields[item.label]
        left, top, right, bottom = reach_on_image(item.camera, item.camera_to_world, subject.field.reach)
        camera = cropped(item.camera, left, top, max(right - left, 1), max(bottom - top, 1))
        maps, depth = subject.surface(camera, item.camera_to_world[None], item.draw.weights)
        rgb, opacity, depth = (part[0].float() for part in (maps.rgb, maps.opacity, depth))
        return Layer(left, top, rgb, opacity, depth)

    def _shown(self, item: DrawnObject, layer: Layer, full: Tensor, visible: Tensor) -> ShownObject:
        mask = layer.opacity > MASK_OPACITY
        box = None
        if bool(mask.any()):
            rows, columns = mask.any(1).nonzero()[:, 0].tolist(), mask.any(0).nonzero()[:, 0].tolist()
            x0, y0 = layer.left + columns[0], layer.top + rows[0]
            box = (x0, y0, layer.left + columns[-1] + 1, layer.top + rows[-1] + 1)
        synthesizer, left, alone = self.scene.synthesizer, int(visible.sum()), int(full.sum())
        enough = max(synthesizer.minimum_area, 1.0, synthesizer.min_visibility * alone)
        masks = (part.cpu().numpy() for part in (full, visible))
        return ShownObject(item, *masks, pixels=int(mask.sum()), box=box, labelled=left >= enough)


def _developed(image: Float[Tensor, "3 height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """Convert an image to 8 bits."""
    return image.clamp(0.0, 1.0).mul(255.0).round().to(torch.uint8).movedim(0, -1).cpu().numpy()


@dataclass(frozen=True, eq=False)
class Layer:
    """Premultiplied colour, opacity and depth (object radii) on a rectangle with its corner at pixel (left, top)."""

    left: int
    top: int
    rgb: Float[Tensor, "h w 3"]
    opacity: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]

    def within(self, height: int, width: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Intersect the rectangle with an image; return the rows and columns in the layer, and in the image."""
        high, wide = self.opacity.shape
        rows = max(0, self.top), max(0, self.top, min(height, self.top + high))
        columns = max(0, self.left), max(0, self.left, min(width, self.left + wide))
        there = slice(*rows), slice(*columns)
        inside = (
            slice(rows[0] - self.top, rows[1] - self.top),
            slice(columns[0] - self.left, columns[1] - self.left),
        )
        return inside, there


def reach_on_image(camera: PinholeCamera, camera_to_world: Float[Tensor, "4 4"], radius: float) -> Box:
    """Return whole pixels (x0, y0, x1, y1) around the image of the ball of ``radius`` about the origin.

    They are clipped to a canvas three times as wide and high as the image: the BOP toolkit, too, counts pixels beyond
    the image on such a canvas. They are empty if the ball has no image.
    """
    x, y, z = (camera_to_world[:3, :3].t() @ -camera_to_world[:3, 3]).tolist()
    sides = []
    for across, focal, centre, size in zip(
        (x, -y), focal_lengths(camera), principal_point(camera), (camera.width, camera.height), strict=True
    ):
        low, high = float(-size), float(2 * size)
        distance = math.hypot(across, z)
        if distance > radius:  # otherwise the camera is within the ball's extent on this axis
            middle, half = math.atan2(across, -z), math.asin(radius / distance)
            if middle - half > -0.5 * math.pi:
                low = max(low, math.floor(centre + focal * math.tan(min(middle - half, 1.57))))
            if middle + half < 0.5 * math.pi:
                high = min(high, math.ceil(centre + focal * math.tan(max(middle + half, -1.57))))
        sides.append((int(low), int(max(low, high))))
    (x0, x1), (y0, y1) = sides
    return x0, y0, x1, y1

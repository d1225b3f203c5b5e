"""A page in the browser that shows an object's field, the cameras of its bins, and renders with detections.

The page needs viser (the extra ``viewer``); ``Shots``, which computes what it shows, does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor
from torchvision.utils import draw_bounding_boxes

from neural_sim import cameras
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.documents import markdown_table
from neural_sim.synthesis.compositing import composite
from neural_sim.synthesis.scene import Scene
from neural_sim.types import PinholeCamera, SceneDraw

GREY = 0.5
"""Grey level of the background of renders."""
WIDE = 280
"""Smallest width of renders on the page, in pixels; captions of boxes need it."""
PER_BIN = 4
"""Number of cameras shown for each bin."""


@dataclass(frozen=True)
class BinCamera:
    """A camera drawn from a bin.

    ``bin`` is the bin's number from 0 and ``p`` its probability. ``draw`` has the camera's scene parameters,
    ``camera_to_world`` its pose (OpenGL axes, object radii).
    """

    bin: int
    p: float
    draw: SceneDraw
    camera_to_world: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Shots:
    """Computes what the viewer shows. ``psi`` has distributions by name, ``detector`` detects objects in renders."""

    scene: Scene
    psi: Mapping[str, Float[Tensor, "objects K"]]
    detector: Detector
    params: Parameters

    def draw(
        self,
        phi_deg: float,
        rho_deg: float,
        distance: float,
        magnification: float | None = None,
        weights: tuple[float, ...] = (),
    ) -> SceneDraw:
        """Return the scene parameters of one image, with the distance in the distribution's unit.

        ``weights`` are those of the anchor lights.
        """

        def one(value: float) -> Tensor:
            return torch.tensor([value], dtype=torch.float32)

        return SceneDraw(
            one(math.radians(phi_deg)), one(math.radians(rho_deg)), one(distance), torch.zeros(1, 0).long(),
            None if magnification is None else one(magnification),
            torch.tensor([weights], dtype=torch.float32) if self.scene.distribution.lights else None,
        )  # fmt: skip

    @torch.no_grad()
    def picture(self, label: int, draw: SceneDraw, above: float = 0.3) -> UInt8[np.ndarray, "height width 3"]:
        """Render the object on grey, enlarged, with the detector's boxes whose score is at least ``above``."""
        shown = self.scene.render(label, draw)
        behind = torch.full_like(shown.rgb, GREY).movedim(-1, 1)
        image = composite(shown.rgb, shown.opacity, behind).clamp(0.0, 1.0)
        (detections,) = self.detector.predict(self.params, image)
        sure = (detections["scores"] >= above).cpu()
        times = -(-WIDE // image.shape[-1])
        pixels = image[0].mul(255.0).round().to(torch.uint8).cpu()
        pixels = pixels.repeat_interleave(times, 1).repeat_interleave(times, 2)
        if sure.any():
            boxes, scores = times * detections["boxes"].cpu()[sure], detections["scores"].cpu()[sure]
            names = [self.scene.names[int(i)] for i in detections["labels"].cpu()[sure]]
            written = [f"{name} {score:.2f}" for name, score in zip(names, scores.tolist(), strict=True)]
            pixels = draw_bounding_boxes(pixels, boxes, written, colors="#e69f00", width=2)
        return pixels.movedim(0, -1).numpy()

    @torch.no_grad()
    def cloud(self, label: int, views: int = 12, size: int = 96) -> tuple[np.ndarray, np.ndarray]:
        """Return points [n, 3] of the field's surface in object radii, and their colours [n, 3] in [0, 1].

        They are the surface points in ``views`` renders around the object, from every height, under equal lights.
        """
        subject = self.scene.fields[label]
        turn = torch.arange(views) * (math.pi * (3.0 - math.sqrt(5.0)))  # a spiral of the golden angle
        height = torch.acos(1.0 - 2.0 * (torch.arange(views) + 0.5) / views)
        camera = PinholeCamera(size, size, math.radians(40.0))
        poses = cameras.orbit(height, turn, torch.full((views,), 3.2))
        poses = poses.to(subject.device, subject.dtype)
        lights = self.scene.distribution.lights
        weights = poses.new_full((views, lights), 1.0 / lights) if lights else None
        maps, depth = subject.surface(camera, poses, weights)
        rays = cameras.rays(camera, poses)
        along = -(rays.directions * poses[:, None, None, :3, 2]).sum(-1)  # depth per unit length of a ray
        points = rays.origins + rays.directions * (depth / along)[..., None]
        solid = depth > 0.0
        colours = maps.rgb[solid] / maps.opacity[solid][:, None].clamp_min(1e-3)
        return points[solid].cpu().numpy(), colours.clamp(0.0, 1.0).cpu().numpy()

    def bin_cameras(self, label: int, which: str, factor: str, seed: int = 0) -> list[BinCamera]:
        """Draw ``PER_BIN`` cameras of every bin of a factor, in the same way as images of that bin."""
        distribution, psi = self.scene.distribution, self.psi[which][label].float()
        p = distribution.probabilities(psi)[factor]
        draw = distribution.probes(factor, PER_BIN, psi, torch.Generator().manual_seed(seed), psi.dtype)
        radius = self.scene.radii[label]
        poses = cameras.orbit(draw.phi, draw.rho, draw.distance, radius=radius).numpy()
        return [
            BinCamera(i // PER_BIN, float(p[i // PER_BIN]), draw.select(slice(i, i + 1)), pose)
            for i, pose in enumerate(poses)
        ]


def colour(p: float, most: float) -> tuple[int, int, int]:
    """Return a colour between grey for 0 and blue for the most likely bin."""
    part = 0.0 if most <= 0.0 else p / most
    low, high = np.array([205, 205, 205]), np.array([0, 90, 178])
    r, g, b = (low + part * (high - low)).round().astype(int).tolist()
    return r, g, b


class Viewer:
    """The page: a 3D view of the field and the cameras of one factor's bins, next to a render with its sliders.

    A click on a camera moves the sliders to it.

    Args:
        shots: computes what the page shows.
        port: the page's port, on this machine's own address only; the next free one if it is taken.
        which: the distribution that is shown first.

    Raises:
        ValueError: viser is missing.
    """

    def __init__(self, shots: Shots, port: int, which: str) -> None:
        try:
            import viser
        except ImportError as error:
            raise ValueError("stages=[viewer] needs viser: pip install 'neural-sim[viewer]'") from error
        self.shots = shots
        self.server = viser.ViserServer(host="127.0.0.1", port=port, label="Neural-Sim", verbose=False)
        gui, scene = self.server.gui, shots.scene
        self.object = gui.add_dropdown("object", scene.names)
        self.which = gui.add_dropdown("distribution", tuple(shots.psi), initial_value=which)
        self.factor = gui.add_dropdown("bins of", [factor.name for factor in scene.distribution.binned])
        ranges = scene.distribution.ranges
        near, far = (float(end) for end in ranges["distance"])
        self.phi = gui.add_slider("phi (degrees)", 0.0, 360.0, 1.0, 90.0)
        self.rho = gui.add_slider("rho (degrees)", -180.0, 180.0, 1.0, 0.0)
        self.distance = gui.add_slider(
            f"distance ({scene.distribution.distance_unit})",
            near,
            max(far, near + 1e-3),
            (far - near) / 100 or 1e-3,
            near,
        )
        zooms = any(factor.coordinate == "magnification" for factor in scene.distribution.binned)
        low, high = (float(end) for end in ranges["magnification"])
        self.magnification = gui.add_slider("focal length", low, high, 0.01, low) if zooms else None
        lights = scene.distribution.lights
        self.lights = [gui.add_slider(f"light {k + 1}", 0.0, 1.0, 0.01, 1.0 / lights) for k in range(lights)]
        self.above = gui.add_slider("boxes above", 0.0, 1.0, 0.05, 0.3)
        self.image = gui.add_image(self.picture(), label="render and detections")
        self.bins = gui.add_markdown("")
        self.object.on_update(lambda _: self.show_object())
        for one in (self.which, self.factor):
            one.on_update(lambda _: self.show_bins())
        for one in self._sliders:
            one.on_update(lambda _: self.show_picture())
        self.frustums: list[Any] = []
        self.show_field()
        self.show_bins()

    @property
    def _sliders(self) -> list[Any]:
        zoom = [] if self.magnification is None else [self.magnification]
        return [self.phi, self.rho, self.distance, *zoom, *self.lights, self.above]

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    @property
    def label(self) -> int:
        """The label of the object shown."""
        return self.shots.scene.names.index(self.object.value)

    def picture(self) -> UInt8[np.ndarray, "height width 3"]:
        """Render the object as the sliders say."""
        zoom = None if self.magnification is None else self.magnification.value
        weights = tuple(light.value for light in self.lights)
        draw = self.shots.draw(self.phi.value, self.rho.value, self.distance.value, zoom, weights)
        return self.shots.picture(self.label, draw, self.above.value)

    def show_picture(self) -> None:
        """Update the render."""
        self.image.image = self.picture()

    def show_object(self) -> None:
        """Show everything of the chosen object: its field, the cameras, and a new render."""
        self.show_field()
        self.show_bins()
        self.show_picture()

    def show_field(self) -> None:
        """Show the points of the chosen object."""
        points, colours = self.shots.cloud(self.label)
        self.server.scene.add_point_cloud("/field", points, colours, point_size=0.02)

    def show_bins(self) -> None:
        """Show the cameras of the chosen object, distribution and factor, and the bins' probabilities."""
        for frustum in self.frustums:
            frustum.remove()
        self.frustums = []
        if self.factor.value is None:
            return
        shown = self.shots.bin_cameras(self.label, self.which.value, self.factor.value)
        most = max(each.p for each in shown)
        self.frustums = [self._frustum(i, each, most) for i, each in enumerate(shown)]
        rows = {each.bin + 1: each.p for each in shown}
        self.bins.content = markdown_table(("bin", "p"), [(b, f"{p:.3f}") for b, p in rows.items()])

    def _frustum(self, number: int, each: BinCamera, most: float) -> Any:
        camera = self.shots.scene.camera
        turn = each.camera_to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # viser looks along +z, y down
        wxyz = Rotation.from_matrix(turn).as_quat(scalar_first=True)
        handle = self.server.scene.add_camera_frustum(
            f"/cameras/{number}", camera.field_of_view, camera.width / camera.height, scale=0.15,
            color=colour(each.p, most), wxyz=wxyz, position=each.camera_to_world[:3, 3],
        )  # fmt: skip
        handle.on_click(lambda _: self.go_to(each))
        return handle

    def go_to(self, each: BinCamera) -> None:
        """Move the sliders to a camera."""
        self.phi.value = math.degrees(float(each.draw.phi)) % 360.0
        self.rho.value = (math.degrees(float(each.draw.rho)) + 180.0) % 360.0 - 180.0
        self.distance.value = float(each.draw.distance)
        if self.magnification is not None and each.draw.magnification is not None:
            self.magnification.value = float(each.draw.magnification)
        self.show_picture()

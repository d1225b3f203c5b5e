"""A page on which the user drags the box around a photographed object and sees it in the photographs.

The page needs viser (the extra ``viewer``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from neural_sim.objects.capture import Capture, Frame
from neural_sim.objects.pictures import Corners
from neural_sim.objects.placing import nearest_to_axes
from neural_sim.pictures import read_picture

SHOWN = 640
"""Longer side of the photograph shown, in pixels."""
SMALL = 64
"""Longer side of the thumbnails at the cameras, in pixels."""
FIRST_SIZE = 0.25
"""Half a side of the initial box, relative to the cameras' median distance from the point they look at."""
ORANGE = (230, 120, 0)
EDGES = tuple(
    (a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1
)  # pairs of corners that differ in one bit, see ``corners_of``


def corners_of(box: Corners) -> Float[np.ndarray, "8 3"]:
    """Return the eight corners; bit k of a corner's index says whether it is at the high end of axis k."""
    return np.array([[box[number >> axis & 1][axis] for axis in range(3)] for number in range(8)])


def first_box(capture: Capture) -> Corners:
    """Return a box around the point that the cameras look at."""
    poses = np.stack([frame.camera_to_world for frame in capture.frames])
    centre = nearest_to_axes(poses)
    half = FIRST_SIZE * float(np.median(np.linalg.norm(poses[:, :3, 3] - centre, axis=1)))
    return _sorted(centre - half, centre + half)


def drawn(frame: Frame, box: Corners) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the edges of a box onto a photograph; an edge with an end behind the camera is left out."""
    picture = read_picture(frame.image, upright=False).convert("RGB")
    picture.thumbnail((SHOWN, SHOWN))
    lens = frame.lens.resized(*picture.size)
    world_to_camera = np.linalg.inv(frame.camera_to_world)
    local = corners_of(box) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    pixels, seen = lens.project(torch.from_numpy(local))
    pen = ImageDraw.Draw(picture)
    for a, b in EDGES:
        if seen[a] and seen[b]:
            pen.line([*pixels[a].tolist(), *pixels[b].tolist()], fill=ORANGE, width=2)
    return np.asarray(picture)


@dataclass
class BoxPage:
    """The page: the cameras with their photographs, a box with two corners to drag, and the box in one photograph.

    Args:
        capture: the photographs and their cameras.
        box: the initial box.
        save: called with the box when the button is pressed; returns a message for the page.
        port: the page's port, on this machine's own address only; the next free one if it is taken.

    Raises:
        ValueError: viser is missing.
    """

    capture: Capture
    box: Corners
    save: Callable[[Corners], str]
    port: int

    def __post_init__(self) -> None:
        try:
            import viser
        except ImportError as error:
            raise ValueError("stages=[box] needs viser: pip install 'neural-sim[viewer]'") from error
        self.server = viser.ViserServer(
            host="127.0.0.1", port=self.port, label=self.capture.name, verbose=False
        )
        gui, frames = self.server.gui, self.capture.frames
        gui.add_markdown(
            "Drag the two corners until the box holds the object and nothing else. Check it in several photographs."
        )
        self.number = gui.add_slider("photograph", 1, max(len(frames), 2), 1, 1)
        self.image = gui.add_image(drawn(frames[0], self.box))
        self.button = gui.add_button("save")
        self.told = gui.add_markdown("")
        reach = float(np.abs(np.subtract(*self.box)).max())
        self.handles = [
            self.server.scene.add_transform_controls(
                f"/corner/{name}", scale=0.4 * reach, disable_rotations=True, position=np.array(corner)
            )
            for name, corner in zip(("low", "high"), self.box, strict=True)
        ]
        self._show_cameras(0.3 * reach)
        self.number.on_update(lambda _: self.show())
        for handle in self.handles:
            handle.on_update(lambda _: self.moved())
        self.button.on_click(lambda _: self.saved())
        self.show()

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def moved(self) -> None:
        """Read the box from the dragged corners."""
        self.box = _sorted(*(np.asarray(handle.position) for handle in self.handles))
        self.show()

    def show(self) -> None:
        """Show the box in the scene and in the chosen photograph."""
        corners = corners_of(self.box)
        lines = np.array([[corners[a], corners[b]] for a, b in EDGES], dtype=np.float32)
        self.server.scene.add_line_segments("/box", lines, np.array(ORANGE))
        number = min(self.number.value, len(self.capture.frames))
        self.image.image = drawn(self.capture.frames[number - 1], self.box)

    def saved(self) -> None:
        """Save the box, and show the message that results."""
        self.told.content = self.save(self.box)

    def _show_cameras(self, scale: float) -> None:
        for number, frame in enumerate(self.capture.frames):
            picture = read_picture(frame.image, upright=False).convert("RGB")
            picture.thumbnail((SMALL, SMALL), Image.Resampling.BOX)
            turn = frame.camera_to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # viser looks along +z, y down
            lens = frame.lens
            handle: Any = self.server.scene.add_camera_frustum(
                f"/cameras/{number}", 2.0 * math.atan(0.5 * lens.height / lens.fy), lens.width / lens.height,
                scale=scale, wxyz=Rotation.from_matrix(turn).as_quat(scalar_first=True),
                position=frame.camera_to_world[:3, 3], image=np.asarray(picture),
            )  # fmt: skip
            handle.on_click(lambda _, number=number: setattr(self.number, "value", number + 1))


def _sorted(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> Corners:
    low, high = np.minimum(one, other).tolist(), np.maximum(one, other).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])

"""A scene without a fit: densities painted into a grid, and cameras round it."""

import math
from pathlib import Path

import numpy as np
import torch

from neural_sim.cameras import orbit
from neural_sim.field.scene.fitting import ScenePixels
from neural_sim.field.scene.grid import SceneGrid
from neural_sim.field.scene.photographs import photo_rays
from neural_sim.field.scene.space import Frame, expand
from neural_sim.objects.capture import Capture, Lens
from neural_sim.objects.capture import Frame as Photo

RESOLUTION = 64
LENS = Lens(80, 60, 90.0, 90.0, 40.0, 30.0)
WHOLE = Frame((0.0, 0.0, 0.0), 1.0)


def painted(solid, resolution: int = RESOLUTION) -> SceneGrid:
    """A grid that is opaque at vertices where ``solid`` is true of points in the normalised frame, else empty."""
    axis = torch.linspace(-2.0, 2.0, resolution + 1)
    points = expand(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).view(-1, 3))
    table = torch.zeros(len(points), 4)
    table[:, 0] = torch.where(solid(points), 3.0, -10.0)
    grid = SceneGrid(resolution, table)
    grid.mark()
    return grid


def cameras(count: int = 8, angles: tuple[float, float] = (0.22, 0.4)) -> Capture:
    """Photographs' cameras round the origin, two away and above it (+z up); their images do not exist."""
    part = torch.arange(count, dtype=torch.float64)
    phi = math.pi * (angles[0] + (angles[1] - angles[0]) * (part % 3) / 2.0)
    poses = orbit(phi, 2.0 * math.pi * part / count, torch.full((count,), 2.0, dtype=torch.float64)).numpy()
    frames = tuple(Photo(Path(f"{n}.png"), pose, LENS) for n, pose in enumerate(poses))
    return Capture("thing", frames, Path("capture.json"), ())


def pixels_of(capture: Capture) -> ScenePixels:
    """All pixels' rays, black."""
    parts = [photo_rays(photo, 80) for photo in capture.frames]
    count = parts[0].seen.numel()
    origins = torch.cat([part.origin.expand(count, 3) for part in parts])
    directions = torch.cat([part.directions.view(-1, 3) for part in parts])
    photo = torch.arange(len(parts)).repeat_interleave(count)
    detail = torch.rand(len(photo), generator=torch.Generator().manual_seed(2))
    return ScenePixels(origins, directions, torch.zeros(len(photo), 3), photo, detail)


def box_of(points, low, high):
    """Whether points are in a box."""
    return ((points > torch.tensor(low)) & (points < torch.tensor(high))).all(-1)


def silhouette(capture: Capture, number: int, low, high) -> np.ndarray:
    """Which pixels' rays meet a box, by the slabs' method."""
    rays = photo_rays(capture.frames[number], 80)
    origin, direction = rays.origin.numpy(), rays.directions.numpy()
    ends = np.stack([(np.array(end) - origin) / direction for end in (low, high)])
    enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
    return (enter < leave) & (leave > 0.0)

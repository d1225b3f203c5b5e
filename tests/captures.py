"""Made captures: photographs of a mesh by a distorted lens over clutter, as transforms.json and as COLMAP."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from scenes import Room
from scipy.spatial.transform import Rotation
from torch.nn import functional

from neural_sim.cameras import orbit
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.objects.procedural import Procedural
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.synthesis.background import ProceduralClutter
from neural_sim.types import PinholeCamera

DISTORTION = {"k1": -0.12, "k2": 0.05, "p1": 0.002, "p2": -0.003}
AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Made:
    """A capture's truth: ``poses`` (OpenGL, capture's frame), intrinsics, and the mesh in the capture's frame."""

    folder: Path
    poses: np.ndarray
    intrinsics: dict[str, float]
    mesh: trimesh.Trimesh
    radius: float
    centre: np.ndarray


def distorted(x: np.ndarray, y: np.ndarray, k: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's documented formula, in its letters."""
    r2 = x**2 + y**2
    radial = 1 + k["k1"] * r2 + k["k2"] * r2**2
    return (
        x * radial + 2 * k["p1"] * x * y + k["p2"] * (r2 + 2 * x**2),
        y * radial + k["p1"] * (r2 + 2 * y**2) + 2 * k["p2"] * x * y,
    )


def undistorted(u: np.ndarray, v: np.ndarray, k: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Its inverse by fixed-point iteration."""
    x, y = u.copy(), v.copy()
    for _ in range(60):
        a, b = distorted(x, y, k)
        x, y = x + u - a, y + v - b
    return x, y


def capture(
    folder: Path,
    name: str = "can",
    count: int = 16,
    width: int = 200,
    height: int = 150,
    kind: str = "transforms",
    masks: str = "files",
    exposure: float = 0.0,
    pose_noise: float = 0.0,
    item: ObjectMesh | None = None,
    scale: float = 0.1,
    renderer: MeshRenderer | None = None,
    distance: tuple[float, float] = (2.8, 3.6),
    suffix: str = ".png",
    distortion: dict[str, float] = DISTORTION,
    angles: tuple[float, float] = (0.25, 0.65),
    room: Room | None = None,
) -> Made:
    """``count`` photographs under ``folder / name``; the object, of radius ``scale``, stands somewhere in a frame whose
    up is -y, as COLMAP's often is. ``pose_noise`` is the deviation of the written positions from the true ones in
    distances, ``exposure`` that of log brightness. ``angles`` are those of the cameras from above, in units of pi.

    Behind the object are clutter that differs from photograph to photograph, or a ``room``, the same in all; then masks
    are written into ``truth``, where nothing looks for them."""
    generator, rng = torch.Generator().manual_seed(3), np.random.default_rng(3)
    item = item or Procedural([name]).load()[0]
    uniform = torch.rand(3, count, generator=generator, dtype=torch.float64)
    phi = math.pi * (angles[0] + (angles[1] - angles[0]) * uniform[0])
    turn = 2.0 * math.pi * (torch.arange(count) + uniform[1]) / count
    far = distance[0] + (distance[1] - distance[0]) * uniform[2]
    own = orbit(phi, turn, far).numpy()
    # z up to -y up, and elsewhere
    turned, centre = Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.array([0.3, -0.2, 1.1])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = turned @ own[:, :3, :3]
    poses[:, :3, 3] = scale * own[:, :3, 3] @ turned.T + centre
    # Nobody aims exactly.
    wobble = Rotation.from_rotvec(rng.normal(0.0, 0.02, (count, 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ wobble
    focal = 1.15 * max(width, height)
    k = {"fl_x": focal, "fl_y": 0.98 * focal, "cx": 0.5 * width + 4.3, "cy": 0.5 * height - 3.1, "w": width,
         "h": height, **distortion}  # fmt: skip
    mesh = item.mesh.copy()
    mesh.apply_transform(_similarity(scale * turned, centre))
    home = folder / name
    (home / "images").mkdir(parents=True)
    truth = home / ("masks" if room is None else "truth")
    truth.mkdir()
    own = np.linalg.inv(_similarity(scale * turned, centre)) @ poses
    photos = _remembered((item.name, own.tobytes(), str(k)), item, own, k, renderer or RaycastRenderer(1))
    walls = ProceduralClutter().draw(count, height, width, generator).movedim(1, -1).numpy()
    if room is not None:
        walls = _behind(room, own, k)
    for number, rgba in enumerate(photos):
        gain = math.exp(exposure * float(rng.normal()))
        colour, alpha = (rgba[..., :3] * gain).clip(0.0, 1.0), rgba[..., 3:]
        if masks == "alpha":
            pixels = np.concatenate([colour, alpha], -1)
        else:
            gains = 1.0 if room is None else gain
            pixels = alpha * colour + (1.0 - alpha) * (gains * walls[number]).clip(0.0, 1.0)
            _save(alpha[..., 0], truth / f"{number:03d}.png")
        _save(pixels, home / "images" / f"{number:03d}{suffix}")
    written = poses.copy()
    step = pose_noise * scale * far.mean().item()
    written[:, :3, 3] += rng.normal(0.0, 1.0, (count, 3)) * step
    names = [f"{number:03d}{suffix}" for number in range(count)]
    if kind == "transforms":
        frames = [{"file_path": f"images/{file}", "transform_matrix": pose.tolist()}
                  for file, pose in zip(names, written, strict=True)]  # fmt: skip
        (home / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **k, "frames": frames}))
    else:
        colmap_text(home / "sparse" / "0", names, written, k)
    if kind == "colmap_binary":
        import pycolmap

        model = pycolmap.Reconstruction(str(home / "sparse" / "0"))
        for file in (home / "sparse" / "0").iterdir():
            file.unlink()
        model.write_binary(str(home / "sparse" / "0"))
    return Made(home, written, k, mesh, scale, centre)


def on_a_table(folder: Path, item: ObjectMesh, **more) -> Made:
    """:func:`capture` of an object that stands on a round table in a room, from above, as people take photographs."""
    room = Room(table=(float(item.mesh.bounds[0][2]), 4.0))
    return capture(folder, item.name, item=item, angles=(0.2, 0.42), room=room, **more)


def colmap_text(folder: Path, names: list[str], poses: np.ndarray, k: dict[str, float]) -> None:
    """COLMAP's text format, by its documentation."""
    folder.mkdir(parents=True)
    lens = " ".join(str(k[key]) for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"))
    (folder / "cameras.txt").write_text(f"# comment\n1 OPENCV {k['w']} {k['h']} {lens}\n")
    lines = []
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), 1):
        world_to_camera = np.linalg.inv(pose @ AXES)
        x, y, z, w = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat()
        numbers = " ".join(f"{value:.17g}" for value in (w, x, y, z, *world_to_camera[:3, 3]))
        lines += [f"{number} {numbers} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("# none\n")


def _behind(room: Room, poses: np.ndarray, k: dict[str, float]) -> np.ndarray:
    """What a lens sees of a room, of poses in its frame (their axes of any length): the mean of four rays a pixel."""
    width, height = int(k["w"]), int(k["h"])
    seen = np.zeros((len(poses), height * width, 3))
    for dx, dy in ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
        u, v = np.meshgrid(
            (np.arange(width) + dx - k["cx"]) / k["fl_x"], (np.arange(height) + dy - k["cy"]) / k["fl_y"]
        )
        x, y = undistorted(u, v, k)
        local = np.stack([x, -y, -np.ones_like(x)], -1).reshape(-1, 3)
        for number, pose in enumerate(poses):
            directions = local @ pose[:3, :3].T
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            seen[number] += 0.25 * room.colours(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    return seen.reshape(len(poses), height, width, 3)


_REMEMBERED: dict[tuple, list[np.ndarray]] = {}


def _remembered(key: tuple, item, own, k, renderer) -> list[np.ndarray]:
    """:func:`_photographs`, once in a process for the same arguments: captures differ in their files more often."""
    key = (*key, type(renderer))
    if key not in _REMEMBERED:
        _REMEMBERED[key] = _photographs(item, own, k, renderer)
    return _REMEMBERED[key]


def _photographs(item, poses, k, renderer) -> list[np.ndarray]:
    """RGBA of each distorted lens, from a larger image without distortion; ``poses`` in the object's frame."""
    width, height = int(k["w"]), int(k["h"])
    u, v = np.meshgrid(
        (np.arange(width) + 0.5 - k["cx"]) / k["fl_x"], (np.arange(height) + 0.5 - k["cy"]) / k["fl_y"]
    )
    x, y = undistorted(u, v, k)
    half = 1.02 * max(np.abs(x).max(), np.abs(y).max())
    side = 2 * max(width, height)
    camera = PinholeCamera(side, side, 2.0 * math.atan(half))
    own = poses.copy()
    scale = np.linalg.norm(own[:, :3, 0], axis=1)
    own[:, :3, :3] /= scale[:, None, None]
    rendered = renderer.render(item.mesh, camera, torch.from_numpy(own)).double()
    rendered = torch.cat([rendered[..., :3] * rendered[..., 3:], rendered[..., 3:]], -1).movedim(-1, 1)
    grid = torch.from_numpy(np.stack([x, y], -1) / half)[None]
    made = []
    for image in rendered:
        pixels = functional.grid_sample(image[None], grid, align_corners=False)[0].movedim(0, -1).numpy()
        alpha = pixels[..., 3:]
        made.append(np.concatenate([pixels[..., :3] / np.maximum(alpha, 1e-6), alpha], -1))
    return made


def _similarity(matrix: np.ndarray, centre: np.ndarray) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = matrix, centre
    return whole


def _save(values: np.ndarray, path: Path) -> None:
    image = Image.fromarray((255.0 * values.clip(0.0, 1.0)).round().astype(np.uint8))
    image.save(path, quality=95) if path.suffix == ".jpg" else image.save(path)

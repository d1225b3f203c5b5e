"""Made photographs with poses: several meshes in one z-buffer, written as YCB-Video and as BOP lay out their files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from neural_sim.objects.procedural import Procedural
from neural_sim.target.ycb_video import read_arrays

MATRIX = np.array([[150.0, 0.0, 61.0], [0.0, 140.0, 43.5], [0.0, 0.0, 1.0]])
SIZE = (120, 90)
FACTOR = 10000
COLOURS = np.array(
    [[200, 40, 40], [40, 70, 200], [230, 200, 40], [60, 160, 70], [240, 240, 240], [120, 60, 30]], np.uint8
)


@dataclass(frozen=True)
class Made:
    """One photograph's truth. ``labels`` are places in ``names`` from 1, 0 for the background; ``whole`` are
    silhouettes of objects without the others; ``poses`` are object_to_camera in OpenCV axes and metres."""

    scene: int
    number: int
    names: tuple[str, ...]
    poses: np.ndarray
    image: np.ndarray
    labels: np.ndarray
    whole: tuple[np.ndarray, ...]
    depth: np.ndarray


def directions(matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Rays [height, width, 3] through pixel centres in OpenCV axes, each with z = 1."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(matrix).T


def z_buffer(
    meshes: Sequence[trimesh.Trimesh], poses: Sequence[np.ndarray], rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Which mesh each ray hits first (from 1, 0 for none), at which depth (0 for none), and each mesh's silhouette."""
    height, width = rays.shape[:2]
    nearest, labels = np.full(height * width, np.inf), np.zeros(height * width, int)
    whole = []
    for number, (mesh, pose) in enumerate(zip(meshes, poses, strict=True), 1):
        own = rays.reshape(-1, 3) @ pose[:3, :3]  # the inverse rotation, on rows
        origin = -pose[:3, :3].T @ pose[:3, 3]
        bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        face = bare.ray.intersects_first(np.tile(origin, (len(own), 1)), own)
        hit = np.flatnonzero(face >= 0)
        normal, corner = bare.face_normals[face[hit]], bare.triangles[face[hit], 0]
        # Rays have z = 1 in the camera, so that their parameter is the depth.
        depth = ((corner - origin) * normal).sum(1) / (own[hit] * normal).sum(1)
        whole.append((face >= 0).reshape(height, width))
        near = depth < nearest[hit]
        nearest[hit[near]], labels[hit[near]] = depth[near], number
    depth = np.where(np.isfinite(nearest), nearest, 0.0)
    return labels.reshape(height, width), depth.reshape(height, width), whole


def meshes_in_metres(names: Mapping[str, str], radius: float = 0.05) -> dict[str, trimesh.Trimesh]:
    """Embedded objects by the class that each stands for, ``radius`` metres large, their centres off the origin."""
    made = {}
    for number, (name, item) in enumerate(zip(names, Procedural(list(names.values())).load(), strict=True)):
        mesh = item.mesh.copy()
        mesh.apply_scale(radius * (1.0 + 0.2 * number))
        mesh.apply_translation((0.004 * number, -0.006, 0.01))
        made[name] = mesh
    return made


def photographs(
    meshes: Mapping[str, trimesh.Trimesh],
    scenes: int = 3,
    frames: int = 4,
    per_frame: int | None = None,
    seed: int = 0,
    matrix: np.ndarray = MATRIX,
    size: tuple[int, int] = SIZE,
) -> list[Made]:
    """Frames of each scene, its objects where they are, the camera shifted and turned a little from one to the next."""
    random = np.random.default_rng(seed)
    names, made = list(meshes), []
    for scene in range(scenes):
        shown = tuple(np.roll(names, -scene)[: per_frame or len(names)].tolist())
        poses = np.tile(np.eye(4), (len(shown), 1, 1))
        poses[:, :3, :3] = Rotation.random(len(shown), random_state=random.integers(1 << 30)).as_matrix()
        poses[:, :3, 3] = random.uniform((-0.07, -0.05, 0.4), (0.07, 0.05, 0.6), (len(shown), 3))
        wall = random.integers(0, 255, (size[1] // 6, size[0] // 6, 3), np.uint8).repeat(6, 0).repeat(6, 1)
        for frame in range(frames):
            camera = np.eye(4)
            camera[:3, :3] = Rotation.from_euler("xyz", 0.03 * frame * np.array([1.0, -1.0, 2.0])).as_matrix()
            camera[:3, 3] = (0.004 * frame, -0.002 * frame, 0.0)
            moved = camera @ poses
            labels, depth, whole = z_buffer(
                [meshes[name] for name in shown], list(moved), directions(matrix, size)
            )
            picture = np.roll(wall, 2 * frame, 1)[: size[1], : size[0]].copy()
            for number, name in enumerate(shown, 1):
                picture[labels == number] = COLOURS[names.index(name) % 6]
            made.append(Made(scene, frame + 1, shown, moved, picture, labels, tuple(whole), depth))
    return made


def write_ycb_video(
    root: Path,
    made: Sequence[Made],
    meshes: Mapping[str, trimesh.Trimesh],
    classes: Sequence[str],
    hdf5: Sequence[int] = (),
    matrix: np.ndarray = MATRIX,
) -> Path:
    """``data/<scene>/...``; ``classes`` are the data set's, of which objects are; scenes in ``hdf5`` as MATLAB 7.3."""
    for item in made:
        folder = root / "data" / f"{item.scene:04d}"
        folder.mkdir(parents=True, exist_ok=True)
        stem = str(folder / f"{item.number:06d}")
        indices = np.array([0, *(classes.index(name) + 1 for name in item.names)], np.uint8)
        Image.fromarray(item.image).save(f"{stem}-color.png")
        Image.fromarray(indices[item.labels]).save(f"{stem}-label.png")
        Image.fromarray((item.depth * FACTOR).round().astype(np.uint16)).save(f"{stem}-depth.png")
        lines = []
        for name, pose in zip(item.names, item.poses, strict=True):
            points = (meshes[name].vertices @ pose[:3, :3].T + pose[:3, 3]) @ matrix.T
            pixels = points[:, :2] / points[:, 2:]
            corners = [*pixels.min(0), *pixels.max(0)]
            lines.append(" ".join([name, *(f"{value:.2f}" for value in corners)]))
        Path(f"{stem}-box.txt").write_text("\n".join(lines) + "\n")
        arrays = {
            "cls_indexes": indices[1:, None].astype(np.float64), "factor_depth": np.array([[float(FACTOR)]]),
            "intrinsic_matrix": matrix, "poses": np.moveaxis(item.poses[:, :3], 0, -1),
        }  # fmt: skip
        write_mat(Path(f"{stem}-meta.mat"), arrays, item.scene in hdf5)
    return root


def write_mat(path: Path, arrays: Mapping[str, np.ndarray], hdf5: bool = False) -> None:
    """As MATLAB saves arrays: trailing dimensions of 1 dropped, HDF5 column by column behind a header of its own."""
    arrays = {
        name: np.squeeze(a, -1) if a.ndim == 3 and a.shape[-1] == 1 else a for name, a in arrays.items()
    }
    if not hdf5:
        scipy.io.savemat(path, dict(arrays))
        return
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array.T
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")


def write_bop(
    root: Path,
    made: Sequence[Made],
    meshes: Mapping[str, trimesh.Trimesh],
    split: str = "test",
    matrix: np.ndarray = MATRIX,
) -> Path:
    """``<split>/<scene>/...`` and ``models``; objects are numbered from 1 in the order of ``meshes``."""
    numbers = {name: number for number, name in enumerate(meshes, 1)}
    (root / "models").mkdir(parents=True, exist_ok=True)
    infos = {}
    for name, mesh in meshes.items():
        scaled = trimesh.Trimesh(1000.0 * mesh.vertices, mesh.faces, process=False)
        scaled.visual.vertex_colors = COLOURS[np.arange(len(mesh.vertices)) % 6]
        scaled.export(root / "models" / f"obj_{numbers[name]:06d}.ply")
        low, extent = scaled.bounds[0], np.ptp(scaled.bounds, axis=0)
        points = scaled.convex_hull.vertices
        across = max(float(np.linalg.norm(points - point, axis=1).max()) for point in points)
        sides = {
            f"{kind}_{a}": float(v[i])
            for kind, v in (("min", low), ("size", extent))
            for i, a in enumerate("xyz")
        }
        infos[str(numbers[name])] = {"diameter": across, **sides}
    (root / "models" / "models_info.json").write_text(json.dumps(infos))
    for scene in sorted({item.scene for item in made}):
        folder = root / split / f"{scene + 1:06d}"
        frames = [item for item in made if item.scene == scene]
        for name in ("rgb", "depth", "mask_visib"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        files: dict[str, dict[str, object]] = {"scene_gt": {}, "scene_gt_info": {}, "scene_camera": {}}
        for item in frames:
            key = str(item.number)
            files["scene_camera"][key] = {"cam_K": matrix.reshape(-1).tolist(), "depth_scale": 0.1}
            files["scene_gt"][key] = [
                {"cam_R_m2c": pose[:3, :3].reshape(-1).tolist(), "cam_t_m2c": (1000.0 * pose[:3, 3]).tolist(),
                 "obj_id": numbers[name]}
                for name, pose in zip(item.names, item.poses, strict=True)
            ]  # fmt: skip
            files["scene_gt_info"][key] = [_info(item, number) for number in range(len(item.names))]
            stem = f"{item.number:06d}"
            Image.fromarray(item.image).save(folder / "rgb" / f"{stem}.png")
            Image.fromarray((item.depth * FACTOR).round().astype(np.uint16)).save(
                folder / "depth" / f"{stem}.png"
            )
            for number in range(len(item.names)):
                mask = (255 * (item.labels == number + 1)).astype(np.uint8)
                Image.fromarray(mask).save(folder / "mask_visib" / f"{stem}_{number:06d}.png")
        for name, content in files.items():
            (folder / f"{name}.json").write_text(json.dumps(content))
    return root


def _info(item: Made, number: int) -> dict[str, object]:
    """As bop_toolkit's calc_gt_info: a box is its first pixel and the difference to its last, -1 for none."""
    mask, whole = item.labels == number + 1, item.whole[number]
    rows, columns = np.nonzero(mask)
    box = [-1, -1, -1, -1]
    if len(rows):
        box = [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)]
    return {"bbox_visib": [int(v) for v in box], "px_count_visib": int(mask.sum()),
            "visib_fract": float(mask.sum() / max(1, whole.sum()))}  # fmt: skip


def change_meta(root, item, **changes):
    """Write a frame's meta file anew with other arrays; None leaves one out."""
    path = root / "data" / f"{item.scene:04d}" / f"{item.number:06d}-meta.mat"
    names = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")
    arrays = {**read_arrays(path, names), **changes}
    write_mat(path, {name: array for name, array in arrays.items() if array is not None})

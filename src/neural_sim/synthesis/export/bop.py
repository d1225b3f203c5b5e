"""A BOP data set: https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md. Millimetres, OpenCV axes.

It has ``train/<scene>/{rgb,depth,mask,mask_visib}`` with ``scene_gt.json``, ``scene_gt_info.json`` and
``scene_camera.json``; and ``models/models_info.json`` with the meshes, if there are any. All objects are listed,
even those of which too little is visible for a label.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist
from trimesh.exchange.ply import export_ply

from neural_sim.synthesis.export.folder import same_file, write_json, write_whole
from neural_sim.synthesis.export.images import ExportImage

SPLIT = "bop/train"
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts OpenGL's camera axes to OpenCV's."""
LARGEST = 65535
"""The largest value in a depth image."""
AT_ONCE = 256
"""Number of points whose distances to all others are held in memory."""


@dataclass(frozen=True, eq=False)
class Model:
    """An object as BOP describes it.

    ``millimetres`` is the radius of its bounding sphere; ``to_model`` maps the object's normalised frame to its
    model's, in millimetres; ``mesh`` is in the latter frame, or None if there is none.
    """

    name: str
    millimetres: float
    to_model: Float[np.ndarray, "4 4"]
    mesh: trimesh.Trimesh | None = None

    def info(self) -> dict[str, float]:
        """Return the entry of ``models_info.json``: the bounding box and the largest distance between two points.

        Without a mesh they are those of the bounding sphere.
        """
        if self.mesh is None:
            low, size = self.to_model[:3, 3] - self.millimetres, np.full(3, 2.0 * self.millimetres)
            diameter = 2.0 * self.millimetres
        else:
            points = np.asarray(self.mesh.vertices)
            low, size = points.min(0), np.ptp(points, axis=0)
            diameter = diameter_of(points)
        sides = {f"{kind}_{axis}": float(v) for kind, values in (("min", low), ("size", size))
                 for axis, v in zip("xyz", values, strict=True)}  # fmt: skip
        return {"diameter": diameter, **sides}

    def pose(self, camera_to_world: Sequence[Sequence[float]]) -> Float[np.ndarray, "4 4"]:
        """Return the rigid model-to-camera matrix, from the camera's pose in the object's normalised frame."""
        # The scales to and from millimetres cancel, so the product is rigid.
        to_camera = (
            np.diag([self.millimetres] * 3 + [1.0]) @ OPENCV @ np.linalg.inv(np.asarray(camera_to_world))
        )
        return to_camera @ np.linalg.inv(self.to_model)


def diameter_of(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the largest distance between two points, which may all lie in a plane or on a line."""
    centred = points - points.mean(0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ axes[extents > 1e-9 * extents[0]].T
    if flat.shape[1] > 1:
        points = points[ConvexHull(flat).vertices]
    elif flat.shape[1] == 1:
        points = points[[flat[:, 0].argmin(), flat[:, 0].argmax()]]
    # All points of a round mesh are on its hull, and the distances of all pairs may not fit into memory.
    starts = range(0, len(points), AT_ONCE)
    return max(float(cdist(points[start : start + AT_ONCE], points[start:]).max()) for start in starts)


def object_ids(class_names: Sequence[str]) -> list[int]:
    """Return BOP's ids: the numbers in names such as ``obj_000003`` if all are such names, otherwise 1, 2, ..."""
    found = [re.fullmatch(r"obj_(\d+)", name) for name in class_names]
    numbers = [int(match[1]) for match in found if match]
    return numbers if len(set(numbers)) == len(found) else list(range(1, len(found) + 1))


def depth_scale(farthest: float) -> float:
    """Return the millimetres of one step of a depth image, a power of ten that reaches ``farthest`` millimetres."""
    return 10.0 ** math.ceil(math.log10(farthest / LARGEST))


def place(number: int, scene_size: int) -> tuple[str, int]:
    """Return the folder of an image's scene, relative to the data set, and the image's number in it."""
    return f"{SPLIT}/{number // scene_size:06d}", number % scene_size


def image_files(image: ExportImage, number: int, scene_size: int, scale: float) -> dict[str, bytes]:
    """Encode the depth and masks of an image, by path."""
    folder, own = place(number, scene_size)
    depth = np.rint(image.depth / scale).clip(0, LARGEST).astype(np.uint16)
    files = {f"{folder}/depth/{own:06d}.png": _png(depth)}
    for index, item in enumerate(image.objects):
        for kind, mask in (("mask", item.full), ("mask_visib", item.visible)):
            files[f"{folder}/{kind}/{own:06d}_{index:06d}.png"] = _png(mask.astype(np.uint8) * np.uint8(255))
    return files


def write_bop(
    folder: Path, records: Sequence[Mapping[str, Any]], models: Sequence[Model], scene_size: int, scale: float
) -> None:
    """Write a whole data set except depth and masks, which are written with the images."""
    names = [model.name for model in models]
    ids = object_ids(names)
    scenes: dict[str, dict[str, dict[str, Any]]] = {}
    for record in records:
        scene, own = place(record["number"], scene_size)
        same_file(folder / record["file"], folder / scene / "rgb" / f"{own:06d}{Path(record['file']).suffix}")
        files = scenes.setdefault(scene, {"scene_gt": {}, "scene_gt_info": {}, "scene_camera": {}})
        objects = record["objects"]
        files["scene_gt"][str(own)] = [
            _pose(models[item["label"]], ids[item["label"]], item) for item in objects
        ]
        files["scene_gt_info"][str(own)] = [_info(item) for item in objects]
        files["scene_camera"][str(own)] = {"cam_K": matrix_of(record["camera"]), "depth_scale": scale}
    for scene, files in scenes.items():
        for name, document in files.items():
            write_json(folder / scene / f"{name}.json", document)
    root = folder / "bop"
    if records:
        camera = records[0]["camera"]
        sides = {key: camera[key] for key in ("width", "height", "fx", "fy", "cx", "cy")}
        write_json(root / "camera.json", sides | {"depth_scale": scale}, indent=1)
    infos = {str(id): model.info() for id, model in zip(ids, models, strict=True)}
    write_json(root / "models" / "models_info.json", infos, indent=1)
    for id, model in zip(ids, models, strict=True):
        if model.mesh is not None:
            text = export_ply(model.mesh, encoding="ascii", vertex_normal=True)
            write_whole(root / "models" / f"obj_{id:06d}.ply", text)
    write_whole(root / "dataset_info.md", _described(names, ids))


def matrix_of(camera: Mapping[str, float]) -> list[float]:
    """Return the camera matrix, row by row."""
    return [camera["fx"], 0.0, camera["cx"], 0.0, camera["fy"], camera["cy"], 0.0, 0.0, 1.0]


def _pose(model: Model, id: int, item: Mapping[str, Any]) -> dict[str, Any]:
    pose = model.pose(item["pose"]["camera_to_world"])
    return {"cam_R_m2c": pose[:3, :3].flatten().tolist(), "cam_t_m2c": pose[:3, 3].tolist(), "obj_id": id}


def _info(item: Mapping[str, Any]) -> dict[str, Any]:
    pixels = item["pixels"]
    boxes = {"bbox_obj": item["box_full"], "bbox_visib": item["box_visible"]}
    return {
        **{key: _toolkit_box(box) if pixels["visible"] else [-1] * 4 for key, box in boxes.items()},
        "px_count_all": pixels["all"],
        "px_count_valid": pixels["valid"],
        "px_count_visib": pixels["visible"],
        "visib_fract": item["visibility"],
    }


def _toolkit_box(box: Sequence[int]) -> list[int]:
    """Return a box as BOP's toolkit writes it: width and height are the last pixel's index minus the first one's."""
    return [box[0], box[1], box[2] - 1, box[3] - 1]


def _described(names: Sequence[str], ids: Sequence[int]) -> str:
    lines = [f"- obj_{id:06d}: {name}" for id, name in zip(ids, names, strict=True)]
    return "\n".join(["# Images drawn by Neural-Sim", "", *lines, "", json.dumps({"split": "train"}), ""])


def _png(grid: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(grid).save(stream, "PNG", compress_level=1)
    return stream.getvalue()

"""Made photographs in one folder per class, and captures as CO3D has them."""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from captures import DISTORTION, capture, on_a_table
from omegaconf import OmegaConf
from PIL import Image

from neural_sim.configuration import conf_directory
from neural_sim.objects.procedural import Procedural


def photographs_by_class(root: Path, names: Sequence[str] = (), count: int = 8) -> Path:
    """``count`` photographs of each of these classes, the embedded objects' unless they are given: noise with a block
    of the class's colour."""
    random = np.random.default_rng(5)
    for number, name in enumerate(names or Procedural().names()):
        colour = random.integers(40, 255, 3, np.uint8)
        (root / name).mkdir(parents=True)
        for photo in range(count):
            picture = random.integers(0, 255, (60, 80, 3), np.uint8)
            left, top = (int(v) for v in random.integers(4, 28, 2))
            picture[top : top + 26, left : left + 30 + number] = colour
            Image.fromarray(picture).save(root / name / f"{photo:04d}.png")
    return root


def objectnet(root: Path) -> Path:
    """Photographs of the folders that the experiment of that name lists, and of another."""
    classes = OmegaConf.load(conf_directory() / "experiment" / "objectnet.yaml").target.classes
    return photographs_by_class(root, [*classes, "squeegee"])


def rooms(root: Path) -> Path:
    """Photographs of a mug on a table in a room, without masks."""
    root.mkdir(parents=True)
    on_a_table(root, Procedural(["mug"]).load()[0], count=28, width=160, height=120)
    return root


def co3d(
    root: Path, names: Sequence[str] = ("can", "mug"), kind: str = "ndc_isotropic", count: int = 16
) -> Path:
    """A sequence of each of these embedded objects, with the cameras of :func:`captures.capture` without distortion."""
    for name in names:
        item = Procedural([name]).load()[0]
        made = capture(
            root / name, "1_2_3", count=count, item=item, distortion=dict.fromkeys(DISTORTION, 0.0)
        )
        (made.folder / "transforms.json").unlink()
        size = [made.intrinsics["h"], made.intrinsics["w"]]
        entries = [
            {
                "sequence_name": "1_2_3", "frame_number": number,
                "image": {"path": f"{name}/1_2_3/images/{number:03d}.png", "size": size},
                "mask": {"path": f"{name}/1_2_3/masks/{number:03d}.png"},
                "viewpoint": viewpoint(pose, made.intrinsics, kind),
            }
            for number, pose in enumerate(made.poses)
        ]  # fmt: skip
        write_jgz(root / name / "frame_annotations.jgz", entries)
        write_jgz(root / name / "sequence_annotations.jgz", [{"sequence_name": "1_2_3", "category": name}])
    return root


def viewpoint(pose: np.ndarray, k: dict[str, float], kind: str) -> dict:
    """An OpenGL camera_to_world and pixel intrinsics as PyTorch3D's camera, by its documentation: a point of the world,
    a row, times R plus T has x to the left, y up and z ahead; NDC runs from +1 at the left and upper edge to -1, along
    the shorter side where it is isotropic."""
    world_to_camera = np.linalg.inv(pose)
    turn = np.diag([-1.0, 1.0, -1.0]) @ world_to_camera[:3]
    unit = np.array([k["w"], k["h"]]) / 2 if kind == "ndc_norm_image_bounds" else min(k["w"], k["h"]) / 2
    focal = np.array([k["fl_x"], k["fl_y"]]) / unit
    point = (np.array([k["w"], k["h"]]) / 2 - np.array([k["cx"], k["cy"]])) / unit
    return {"R": turn[:, :3].T.tolist(), "T": turn[:, 3].tolist(), "focal_length": focal.tolist(),
            "principal_point": point.tolist(), "intrinsics_format": kind}  # fmt: skip


def write_jgz(path: Path, entries: list) -> None:
    path.write_bytes(gzip.compress(json.dumps(entries).encode()))

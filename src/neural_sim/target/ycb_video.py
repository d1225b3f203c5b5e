"""YCB-Video in its original layout (Xiang et al., PoseCNN, RSS 2018).

``data/<scene>/<frame>-{color,label,depth}.png``, ``-box.txt`` (class, x0, y0, x1, y1 of the whole object's projection,
from the centre of the upper left pixel) and ``-meta.mat`` (poses in metres, camera matrix); ``image_sets/*.txt`` with a
line <scene>/<frame> for each frame.
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.io
from typing_extensions import override

from neural_sim.extras import require
from neural_sim.pictures import read_grid, read_header, without_leftovers
from neural_sim.ranges import validated
from neural_sim.target.frames import (
    Frame,
    FrameName,
    FrameReader,
    Listed,
    PosedObject,
    box_of_mask,
    camera_of_matrix,
    numbers,
    rigid,
)
from neural_sim.target.posed_target import PosedTarget
from neural_sim.types import PinholeCamera

_log = logging.getLogger(__name__)

CLASSES = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle",
    "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana",
    "019_pitcher_base", "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block",
    "037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)  # fmt: skip
"""The data set's classes 1 to 21, named like the objects' folders."""
Box = tuple[float, float, float, float]
_ELEMENTS, _MATRIX, _COMPRESSED = frozenset({*range(1, 8), 9, *range(12, 19)}), 14, 15
"""Types of the elements of a MATLAB file, version 5."""


@validated
@dataclass(frozen=True)
class YcbVideoTarget(PosedTarget):
    """Photographs of YCB-Video.

    Args:
        val_list: the list in ``image_sets`` for validation, with one in ``every`` photographs of each scene; None:
            ``train`` if present, otherwise scenes that no other part has.
        test_list: the list that is scored, all of it; None: ``keyframe`` if present, otherwise scenes that no other
            part has.

    See ``PosedTarget`` for the other arguments.
    """

    val_list: str | None = None
    test_list: str | None = None

    @cached_property
    @override
    def reader(self) -> YcbVideoScenes:
        return YcbVideoScenes(self._root)

    @override
    def listed(self) -> Listed:
        val = self._list("val_list", self.val_list, "train")
        test = self._list("test_list", self.test_list, "keyframe")
        if val is not None:
            val = self._thinned(val)
        if val is None and test is None:
            return Listed(self._thinned(self.reader.names), None)
        if val is None:
            val = self._without(test or ())
        return Listed(val, self._without(val) if test is None else test)

    def _without(self, taken: Sequence[FrameName]) -> list[FrameName]:
        """Keep every n-th photograph of the scenes from which ``taken`` has none."""
        scenes = {name.scene for name in taken}
        return self._thinned([name for name in self.reader.names if name.scene not in scenes])

    def _thinned(self, names: Sequence[FrameName]) -> list[FrameName]:
        scenes: dict[str, list[FrameName]] = {}
        for name in sorted(names):
            scenes.setdefault(name.scene, []).append(name)
        return [name for scene in scenes.values() for name in scene[:: self.every]]

    def _list(self, key: str, given: str | None, usual: str) -> list[FrameName] | None:
        """Read the photographs of a list; None if none is given and the usual one does not exist."""
        path = self._root / "image_sets" / f"{given or usual}.txt"
        if not path.is_file():
            if given is None:
                return None
            raise ValueError(f"target.{key}: no such file: {path}")
        found = []
        for number, line in enumerate(map(str.strip, _text(path).splitlines()), 1):
            scene, _, frame = line.removeprefix("data/").rpartition("/")
            if not line or scene == "data_syn":  # rendered images, which do not belong to the target
                continue
            if not scene or "/" in scene or not frame.isdecimal():
                raise ValueError(f"{path}: line {number}: want <scene>/<frame>, got {line!r}")
            found.append(FrameName(scene, int(frame)))
        names = list(dict.fromkeys(found))
        if len(names) < len(found):
            _log.warning("%s: %d lines repeat a frame and are left out", path, len(found) - len(names))
        absent = [name for name in names if not self.reader.file(name, "color.png").is_file()]
        if absent:
            raise ValueError(
                f"{path}: {len(absent)} of {len(names)} frames have no image, the first {absent[0]}"
            )
        return names


@dataclass(frozen=True)
class YcbVideoScenes(FrameReader):
    """The files of YCB-Video. An object's centre is assumed to be the origin of its poses.

    An object's box is that of its pixels in ``-label.png``. Its visibility is the fraction of the box of its whole
    projection (clipped to the image) that this box covers, because the data set has no masks of whole objects. Without
    ``-label.png``, the box of the whole projection is taken, and the object counts as visible.
    """

    root: Path

    @cached_property
    def names(self) -> list[FrameName]:
        """All photographs.

        Raises:
            ValueError: the name of a photograph has no number.
        """
        folder = self.root / "data"
        names = []
        for path in without_leftovers(sorted(folder.glob("*/*-color.png")), folder):
            frame = path.name.removesuffix("-color.png")
            if not frame.isdecimal():
                raise ValueError(f"{path}: want <number>-color.png")
            names.append(FrameName(path.parent.name, int(frame)))
        return sorted(names)

    @override
    def class_names(self, scenes: Collection[str]) -> list[str]:
        return list(CLASSES)

    @override
    def centre(self, class_name: str) -> None:
        return None

    @override
    def frame(self, name: FrameName, depth: bool = False) -> Frame:
        meta = self.file(name, "meta.mat")
        image, label_file = self.file(name, "color.png"), self.file(name, "label.png")
        arrays = read_arrays(meta, ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth"))
        size = read_header(image).stored
        camera = camera_of_matrix(arrays["intrinsic_matrix"], *size, f"{meta}: intrinsic_matrix")
        classes = [int(value) for value in arrays["cls_indexes"].reshape(-1)]
        poses = _poses(arrays["poses"], classes, meta)
        labels = read_grid(label_file, size) if label_file.is_file() else None
        if labels is not None and (stray := sorted(set(np.unique(labels).tolist()) - {0, *classes})):
            raise ValueError(f"{label_file}: shows classes {stray}, of which {meta.name} has no pose")
        whole = _boxes(self.file(name, "box.txt"), size)
        objects = []
        for index, pose in zip(classes, poses, strict=True):
            class_name = CLASSES[index - 1]
            if class_name not in whole:
                raise ValueError(
                    f"{self.file(name, 'box.txt')}: has no box of {class_name}, of which {meta.name} has a pose"
                )
            mask = None if labels is None else labels == index
            box = whole[class_name] if mask is None else box_of_mask(mask)
            objects.append(PosedObject(class_name, pose, box, _visibility(box, whole[class_name]), mask))
        depths = self._depth(name, size, arrays["factor_depth"]) if depth else None
        return Frame(name.scene, name.number, image, camera, tuple(objects), depths)

    def _depth(self, name: FrameName, size: tuple[int, int], factor: np.ndarray) -> np.ndarray | None:
        file = self.file(name, "depth.png")
        per_metre = float(numbers(factor, 1, f"{self.file(name, 'meta.mat')}: factor_depth")[0])
        return read_grid(file, size) / per_metre if file.is_file() else None

    @override
    def camera(self, name: FrameName) -> PinholeCamera:
        meta = self.file(name, "meta.mat")
        matrix = read_arrays(meta, ("intrinsic_matrix",))["intrinsic_matrix"]
        return camera_of_matrix(
            matrix, *read_header(self.file(name, "color.png")).stored, f"{meta}: intrinsic_matrix"
        )

    @override
    def files(self, name: FrameName) -> list[Path]:
        return [self.file(name, end) for end in ("color.png", "label.png", "box.txt", "meta.mat")]

    def file(self, name: FrameName, end: str) -> Path:
        """Return the file of a photograph with this ending."""
        return self.root / "data" / name.scene / f"{name.number:06d}-{end}"


def _poses(poses: np.ndarray, classes: Sequence[int], meta: Path) -> list[np.ndarray]:
    strange = [index for index in classes if not 1 <= index <= len(CLASSES)]
    if strange or len(set(classes)) < len(classes):
        raise ValueError(
            f"{meta}: cls_indexes: want different numbers from 1 to {len(CLASSES)}, got {list(classes)}"
        )
    if poses.size != 12 * len(classes) or (classes and poses.shape[:2] != (3, 4)):
        raise ValueError(
            f"{meta}: poses: want 3 x 4 x {len(classes)}, one for each of cls_indexes, got "
            + " x ".join(map(str, poses.shape))
        )
    stacked = poses.reshape(3, 4, len(classes))
    return [
        rigid(stacked[:, :3, i], stacked[:, 3, i], f"{meta}: poses: {CLASSES[index - 1]}")
        for i, index in enumerate(classes)
    ]


def _boxes(path: Path, size: tuple[int, int]) -> dict[str, Box | None]:
    """Read the boxes of whole projections by class, along pixel edges, clipped to the image; None if outside it."""
    lines = _text(path).splitlines()
    boxes: dict[str, Box | None] = {}
    for number, words in enumerate(map(str.split, lines), 1):
        if len(words) != 5:
            raise ValueError(f"{path}: line {number}: want a class and four numbers, got {' '.join(words)!r}")
        corners = numbers(words[1:], 4, f"{path}: line {number}") + 0.5  # from the corner of the first pixel
        x0, y0, x1, y1 = (float(v) for v in np.clip(corners, 0.0, (*size, *size)))
        boxes[words[0]] = (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
    return boxes


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable ({error})") from error


def _visibility(visible: Box | None, whole: Box | None) -> float:
    if visible is None:
        return 0.0
    if whole is None:
        return 1.0
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (visible, whole)]
    return min(1.0, areas[0] / areas[1])


def _check_elements(data: bytes, order: str) -> None:
    """Check the tags of a MATLAB file's elements, nested ones included: scipy crashes on unknown types.

    Args:
        data: consecutive elements: type and size (four bytes each; two each for contents of up to four), then content.
        order: byte order, ``<`` or ``>``.

    Raises:
        ValueError: a type is unknown, or an element reaches beyond the end.
    """
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("ends within an element")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        short = kind >> 16
        if short:
            kind, size, start = kind & 0xFFFF, short, at + 4
        else:
            start = at + 8
        if kind not in _ELEMENTS or start + size > len(data) or (short and size > 4):
            raise ValueError(f"an element has the type {kind} and {size} bytes")
        content = data[start : start + size]
        if kind == _COMPRESSED:
            _check_elements(zlib.decompress(content), order)
        elif kind == _MATRIX:
            _check_elements(content, order)
        at = start + (4 if short else size)
        if kind != _COMPRESSED:
            at += -at % 8


def read_arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read arrays from a MATLAB file, version 5 or 7.3 (HDF5); their shapes are MATLAB's.

    Other arrays in the file are not read. MATLAB stores arrays column by column, which HDF5 reads as the transpose.
    MATLAB drops trailing dimensions of size 1: the poses of one object are 3 x 4, those of two 3 x 4 x 2.

    Raises:
        ValueError: the file is missing, is not a MATLAB file, or lacks a name.
    """
    require("bop", str(path))
    import h5py

    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                found = {
                    name: np.asarray(file[name]).T
                    for name in names
                    if isinstance(file.get(name), h5py.Dataset)
                }
        else:
            data = path.read_bytes()
            _check_elements(data[128:], "<" if data[126:128] == b"IM" else ">")
            found = scipy.io.loadmat(path, variable_names=list(names))
    except Exception as error:  # on damaged files, both readers raise arbitrary exceptions
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: not a readable MATLAB file ({reason})") from error
    lacking = [name for name in names if name not in found]
    if lacking:
        raise ValueError(f"{path}: lacks {lacking}")
    return {name: np.asarray(found[name]) for name in names}

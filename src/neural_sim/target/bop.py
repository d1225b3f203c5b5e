"""Scenes of a BOP benchmark data set: https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md.

``<split>/<scene>/{scene_gt,scene_gt_info,scene_camera}.json`` next to ``rgb`` (or ``gray``), ``depth`` and
``mask_visib``; ``models/models_info.json``; ``test_targets_bop19.json``. Lengths are in millimetres, axes as in OpenCV.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from typing_extensions import override

from neural_sim.documents import read_json
from neural_sim.pictures import by, read_grid, read_header
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

MILLIMETRE = 1e-3
TARGETS = "test_targets_bop19.json"
IMAGES = tuple(
    f"{kind}/*.{form}" for kind in ("rgb", "gray", "grey") for form in ("png", "jpg", "tif", "tiff", "jpeg")
)
DEPTHS = ("depth/*.png", "depth/*.tif", "depth/*.tiff")


@validated
@dataclass(frozen=True)
class BopTarget(PosedTarget):
    """Photographs of a BOP data set. Classes are ``obj_000001`` and so on.

    Args:
        val: folder of the validation scenes, with one in ``every`` photographs of each, such as ``train_real``; None:
            scenes of ``test``.
        test: folder of the scenes that are scored: the images in ``test_targets_bop19.json`` if it is present and the
            folder is ``test``, otherwise one in ``every`` photographs of each scene.

    See ``PosedTarget`` for the other arguments.
    """

    val: str | None = None
    test: str = "test"

    @cached_property
    @override
    def reader(self) -> BopScenes:
        return BopScenes(self._root)

    @override
    def listed(self) -> Listed:
        whole = self.test == "test" and (self._root / TARGETS).is_file()
        scored = _targets(self._root / TARGETS) if whole else self._thinned(self.test)
        return Listed(scored, None) if self.val is None else Listed(self._thinned(self.val), scored)

    def _thinned(self, split: str) -> list[FrameName]:
        """Keep every n-th image of each scene of a folder."""
        folder = self._root / split
        scenes = sorted(path.parent.name for path in folder.glob("*/scene_gt.json"))
        if not scenes:
            raise ValueError(f"{folder}: holds no scene (<scene>/scene_gt.json)")
        return [
            FrameName(f"{split}/{scene}", number)
            for scene in scenes
            for number in self.reader.numbers(f"{split}/{scene}")[:: self.every]
        ]


def _targets(path: Path) -> list[FrameName]:
    entries, names = read_json(path), set()
    if not isinstance(entries, list):
        raise ValueError(f"{path}: want a list of targets")
    for number, entry in enumerate(entries):
        where = f"{path}: [{number}]"
        _want(entry, ("scene_id", "im_id"), where)
        scene, image = (_whole(entry[key], f"{where}: {key}") for key in ("scene_id", "im_id"))
        names.add(FrameName(f"test/{scene:06d}", image))
    return sorted(names)


@dataclass(frozen=True)
class BopScenes(FrameReader):
    """The files of a BOP data set.

    An object's centre is the centre of its box in ``models/models_info.json`` or, without that file, the origin of its
    poses; its visibility is ``visib_fract``. Its box is that of its mask or, without one, ``bbox_visib``.
    """

    root: Path

    @override
    def class_names(self, scenes: Collection[str]) -> list[str]:
        if self._info:
            return sorted(_class_name(number, str(self._info_file)) for number in self._info)
        shown = (
            item
            for scene in scenes
            for items in self._json(scene, "scene_gt.json").values()
            for item in items
        )
        return sorted(
            {
                _class_name(item["obj_id"], f"{self.root}: obj_id")
                for item in shown
                if isinstance(item, dict) and "obj_id" in item
            }
        )

    def numbers(self, scene: str) -> list[int]:
        """List the images of a scene."""
        return sorted(map(int, self._json(scene, "scene_gt.json")))

    @override
    def frame(self, name: FrameName, depth: bool = False) -> Frame:
        poses, infos = self._entry(name, "scene_gt.json"), self._entry(name, "scene_gt_info.json")
        where = f"{self._folder(name) / 'scene_gt.json'}: {name.number}"
        if not isinstance(poses, list) or not isinstance(infos, list) or len(poses) != len(infos):
            raise ValueError(f"{where}: want a list of objects, and as many in scene_gt_info.json")
        camera, size = self.camera(name), read_header(self._image(name)).stored
        objects = [
            self._object_of(name, i, *both, size) for i, both in enumerate(zip(poses, infos, strict=True))
        ]
        return Frame(
            name.scene,
            name.number,
            self._image(name),
            camera,
            tuple(objects),
            self._depth(name, size) if depth else None,
        )

    def _object_of(
        self, name: FrameName, index: int, pose: Any, info: Any, size: tuple[int, int]
    ) -> PosedObject:
        where, said = (
            f"{self._folder(name) / file}: {name.number}[{index}]"
            for file in ("scene_gt.json", "scene_gt_info.json")
        )
        _want(pose, ("obj_id", "cam_R_m2c", "cam_t_m2c"), where)
        _want(info, ("visib_fract", "bbox_visib"), said)
        moved = rigid(
            pose["cam_R_m2c"], numbers(pose["cam_t_m2c"], 3, f"{where}: cam_t_m2c") * MILLIMETRE, where
        )
        file = self._mask(name, index)
        mask = read_grid(file, size) > 0 if file.is_file() else None
        if mask is not None:
            box = box_of_mask(mask)
        else:
            # The toolkit's width and height are differences between last and first pixels.
            x, y, width, height = numbers(info["bbox_visib"], 4, f"{said}: bbox_visib").tolist()
            box = (x, y, x + width + 1, y + height + 1) if width >= 0 and height >= 0 else None
        visible = float(numbers(info["visib_fract"], 1, f"{said}: visib_fract")[0])
        if not 0.0 <= visible <= 1.0:
            raise ValueError(f"{said}: visib_fract: want a fraction from 0 to 1, got {visible:g}")
        return PosedObject(_class_name(pose["obj_id"], f"{where}: obj_id"), moved, box, visible, mask)

    @override
    def camera(self, name: FrameName) -> PinholeCamera:
        entry = self._entry(name, "scene_camera.json")
        where = f"{self._folder(name) / 'scene_camera.json'}: {name.number}"
        _want(entry, ("cam_K",), where)
        size = read_header(self._image(name)).stored
        said = (entry.get("width", size[0]), entry.get("height", size[1]))
        if said != size:
            raise ValueError(
                f"{where}: is for images of {by(said)} pixels, {self._image(name)} has {by(size)}"
            )
        return camera_of_matrix(entry["cam_K"], *size, f"{where}: cam_K")

    def _depth(self, name: FrameName, size: tuple[int, int]) -> np.ndarray | None:
        file = self._file(name, DEPTHS)
        if not file.is_file():
            return None
        entry = self._entry(name, "scene_camera.json")
        where = f"{self._folder(name) / 'scene_camera.json'}: {name.number}"
        _want(entry, ("depth_scale",), where)
        return read_grid(file, size) * (float(numbers(entry["depth_scale"], 1, where)[0]) * MILLIMETRE)

    @override
    def centre(self, class_name: str) -> Float[np.ndarray, "3"] | None:
        entry = self._info.get(str(int(class_name.removeprefix("obj_"))))
        if entry is None:
            return None
        where = f"{self._info_file}: {class_name}"
        _want(entry, [f"{kind}_{axis}" for kind in ("min", "size") for axis in "xyz"], where)
        low, size = (
            numbers([entry[f"{kind}_{axis}"] for axis in "xyz"], 3, where) for kind in ("min", "size")
        )
        return (low + 0.5 * size) * MILLIMETRE

    @property
    def _info_file(self) -> Path:
        return self.root / "models" / "models_info.json"

    @cached_property
    def _info(self) -> dict[str, Any]:
        return _mapping(self._info_file) if self._info_file.is_file() else {}

    @cached_property
    def _read(self) -> dict[tuple[str, str], dict[str, Any]]:
        return {}

    def _json(self, scene: str, file: str) -> dict[str, Any]:
        """Read a scene's file, once."""
        if (scene, file) not in self._read:
            self._read[scene, file] = _mapping(self.root / scene / file)
        return self._read[scene, file]

    def _entry(self, name: FrameName, file: str) -> Any:
        entries = self._json(name.scene, file)
        if str(name.number) not in entries:
            raise ValueError(f"{self._folder(name) / file}: has no entry of image {name.number}")
        return entries[str(name.number)]

    def _folder(self, name: FrameName) -> Path:
        return self.root / name.scene

    def _mask(self, name: FrameName, index: int) -> Path:
        return self._folder(name) / "mask_visib" / f"{name.number:06d}_{index:06d}.png"

    def _image(self, name: FrameName) -> Path:
        return self._file(name, IMAGES)

    def _file(self, name: FrameName, forms: Sequence[str]) -> Path:
        """Return the first of a photograph's possible files that exists; if none does, the first."""
        files = [self._folder(name) / form.replace("*", f"{name.number:06d}") for form in forms]
        return next((file for file in files if file.is_file()), files[0])

    @override
    def files(self, name: FrameName) -> list[Path]:
        folder = self._folder(name)
        labels = [folder / file for file in ("scene_gt.json", "scene_gt_info.json", "scene_camera.json")]
        shown = self._entry(name, "scene_gt.json")
        masks = (self._mask(name, index) for index in range(len(shown) if isinstance(shown, list) else 0))
        return [*labels, self._image(name), *masks, *([self._info_file] if self._info else [])]


def _class_name(number: int | str, where: str) -> str:
    return f"obj_{_whole(number, where):06d}"


def _whole(value: Any, where: str) -> int:
    """Return a number from 0, which a file may write as 3, 3.0 or "3"."""
    try:
        number = int(value)
        if number < 0 or float(value) != number:
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{where}: want a whole number of at least 0, got {value!r}") from None
    return number


def _want(entry: Any, keys: Sequence[str], where: str) -> None:
    lacking = [key for key in keys if not isinstance(entry, dict) or key not in entry]
    if lacking:
        raise ValueError(f"{where}: lacks {lacking}")


def _mapping(path: Path) -> dict[str, Any]:
    """Read a JSON file of entries by number. Raises ``ValueError`` for any other file."""
    data = read_json(path)
    if not isinstance(data, dict) or not all(key.isdecimal() for key in data):
        raise ValueError(f"{path}: want entries by number")
    return {str(int(key)): value for key, value in data.items()}

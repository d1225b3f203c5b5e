"""Photographs of objects: one folder per object, with ``transforms.json`` or a COLMAP sparse model."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

from neural_sim.objects.capture import Capture, Frame
from neural_sim.objects.colmap import model_folder, read_colmap
from neural_sim.objects.files import Names, choose, content_digest, folder_of
from neural_sim.objects.pictures import (
    Box,
    Direction,
    Masks,
    Pictures,
    SceneMaskMaker,
    box_of,
    check_masks,
    mask_of,
)
from neural_sim.objects.placing import AXES, Placement, mean_up, nearest_to_axes, place, upright
from neural_sim.objects.resampling import pixels_per_pixel, resample
from neural_sim.objects.transforms_json import has_transforms, read_transforms
from neural_sim.ranges import Matching, Positive, validated
from neural_sim.types import PosedViews

_log = logging.getLogger(__name__)

Up = (
    Literal["+x", "-x", "+y", "-y", "+z", "-z"]
    | Annotated[Direction, Matching(any, "three numbers, not all of them zero")]
)


class PoseCorrector(Protocol):
    """Corrects the poses of an object's photographs."""

    def refine(self, views: PosedViews, held_out: int) -> PosedViews:
        """The views, of which the last ``held_out`` are test frames, at corrected poses."""
        ...


@validated
class Photos:
    """Captures of a folder; an object has the name of its folder.

    Args:
        root: the folder of the objects' folders.
        names: objects to load; null: all.
        masks: source of the objects' masks, see :class:`Pictures`.
        up: the world's up direction in a capture's frame: ``+x``, ``-x``, ``+y``, ..., or three numbers; a mapping by
            object's name; null: that of the capture's file, else the mean of the cameras' up vectors.
        size: the diameter of the object's bounding sphere in metres, or a mapping by object's name; null: unknown, so
            that distances are in object radii.
        box: with ``masks="scene"``: two corners of a box about the object, along the axes of the capture's frame and in
            its unit, or a mapping by object's name; null: the object is looked for where the cameras look.
        scene: what computes masks where ``masks="scene"``.
        poses: what corrects the cameras' poses; null: they stay as they are given.
        poor: what happens where a field does not show its object: nothing trains on it (``refuse``), or ``use``.

    Raises:
        ValueError: a missing folder, one without captures, an unknown name, ``masks="scene"`` without ``scene``,
            ``box`` without ``masks="scene"``, or a capture that its reader refuses.
    """

    def __init__(
        self,
        root: str | Path,
        names: Names = None,
        masks: Masks = "auto",
        up: Up | Mapping[str, Up | None] | None = None,
        size: Positive | Mapping[str, Positive | None] | None = None,
        box: Box | Mapping[str, Box | None] | None = None,
        scene: SceneMaskMaker | None = None,
        poses: PoseCorrector | None = None,
        poor: Literal["refuse", "use"] = "refuse",
    ) -> None:
        self.root = folder_of(root)
        captures = self._found()
        self._folders = {name: captures[name] for name in choose(captures, names, {}, str(self.root))}
        self.masks: Masks = masks
        self.up, self.size, self.box, self.scene, self.poses, self.poor = up, size, box, scene, poses, poor
        if masks == "scene" and scene is None:
            raise ValueError("objects.masks=scene: want objects.scene, which computes masks, got none")
        if masks != "scene" and box is not None:
            raise ValueError(f"objects.box wants objects.masks=scene, got objects.masks={masks}")
        for capture in self.captures.values():  # errors in a file are raised here, not in a later stage
            if masks in ("auto", "files"):
                check_masks(capture)

    def _found(self) -> dict[str, Path]:
        """The captures' folders below the root, by the names of their objects."""
        captures = {p.name: p for p in sorted(self.root.iterdir()) if p.is_dir() and is_capture(p)}
        if not captures:
            raise ValueError(
                f"objects.root: {self.root} holds no folder with a transforms.json or a COLMAP model"
            )
        return captures

    def _read(self, name: str) -> Capture:
        folder = self._folders[name]
        return (read_transforms if has_transforms(folder) else read_colmap)(folder, name)

    def names(self) -> list[str]:
        return list(self._folders)

    @cached_property
    def captures(self) -> dict[str, Capture]:
        """Frames and cameras by object; photographs are not read."""
        return {name: self._read(name) for name in self._folders}

    def digests(self) -> dict[str, str]:
        """SHA-256 of each capture's files, masks included, and of the options that apply to it."""
        return {name: self._digest(name) for name in self._folders}

    def radius(self, name: str) -> float | None:
        """Radius of an object's bounding sphere in metres, None if unknown."""
        size = self.size.get(name) if isinstance(self.size, Mapping) else self.size
        return None if size is None else 0.5 * float(size)

    def split(self, name: str, count: int, held_out: int) -> tuple[list[Frame], list[Frame]]:
        """At most ``count`` training frames and ``held_out`` test frames, evenly spread.

        Test frames are the capture's own if it has any, else at most an eighth of all frames.

        Raises:
            ValueError: fewer than two training frames.
        """
        frames = self.captures[name].frames
        test = [frame for frame in frames if frame.test]
        train = [frame for frame in frames if not frame.test]
        if not test:
            test = _spread(train, min(held_out, max(1, len(train) // 8)))
            train = [frame for frame in train if frame not in test]
        if len(train) < 2:
            raise ValueError(
                f"{self.captures[name].source}: want at least 2 frames to train on, got {len(train)}"
            )
        return _spread(train, count), _spread(test, held_out)

    def computed_masks(self, name: str) -> tuple[Float[Tensor, "_ _"], ...]:
        """A mask for each frame of an object's capture where ``masks="scene"``, else none."""
        if self.scene is None or self.masks != "scene":
            return ()
        return self.scene.masks(self.captures[name], self._up(name), box_of(self.box, name))

    def pictures(self, name: str, computed: tuple[Float[Tensor, "_ _"], ...] | None = None) -> Pictures:
        """An object's photographs; ``computed`` are its :meth:`computed_masks`, None: they are computed now."""
        return Pictures(
            self.captures[name], self.masks, self.computed_masks(name) if computed is None else computed
        )

    def placement(self, name: str, pictures: Pictures | None = None) -> Placement:
        """An object's pose and radius in its capture's frame."""
        return place(pictures or self.pictures(name), self._up(name), box_of(self.box, name))

    def views(
        self, name: str, count: int, held_out: int, image_size: int, pictures: Pictures | None = None
    ) -> PosedViews:
        """Views of an object, test frames last, see :meth:`split` and :func:`resampling.resample`; then ``poses``."""
        train, test = self.split(name, count, held_out)
        pictures = pictures or self.pictures(name)
        views = resample(pictures, [*train, *test], self.placement(name, pictures), image_size)
        finest = max(pixels_per_pixel(frame, views.camera) for frame in train)
        _log.info(
            "%s: %d photographs train and %d score; a pixel of views.image_size=%d covers up to %.1f of theirs a side",
            name, len(train), len(test), image_size, finest,
        )  # fmt: skip
        return views if self.poses is None else self.poses.refine(views, len(test))

    def up_of(self, name: str) -> tuple[float, float, float]:
        """The up direction in an object's capture's frame: as set, else its file's, else the mean of the cameras'."""
        capture = self.captures[name]
        return self._up(name) or capture.up or mean_up(capture)

    def directions(self, name: str) -> Float[np.ndarray, "photos 3"]:
        """Unit vectors from where an object's cameras look, or from its box, to the cameras, in the object's frame.

        No photograph is read: masks would move the centre a little, and the directions by some degrees.
        """
        poses = np.stack([frame.camera_to_world for frame in self.captures[name].frames])
        box = box_of(self.box, name)
        centre = nearest_to_axes(poses) if box is None else np.array(box).mean(0)
        away = (poses[:, :3, 3] - centre) @ upright(np.array(self.up_of(name)), name).T
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def _up(self, name: str) -> tuple[float, float, float] | None:
        up: Any = self.up.get(name) if isinstance(self.up, Mapping) else self.up
        if up is None:
            return None
        x, y, z = AXES[up] if isinstance(up, str) else up
        return float(x), float(y), float(z)

    def _digest(self, name: str) -> str:
        capture, folder = self.captures[name], self._folders[name]
        read = () if self.masks == "scene" else capture.frames
        masks = (mask_of(frame, capture.source) for frame in read)
        files = dict.fromkeys([*capture.files, *(path for path in masks if path is not None)])
        listed = {
            str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path): path
            for path in files
        }
        options = f"{self.masks} {self._up(name)} {box_of(self.box, name)} "
        return content_digest({options: Path(), **listed})


def is_capture(folder: Path) -> bool:
    """Whether a folder has a capture's camera files."""
    return has_transforms(folder) or model_folder(folder) is not None


def _spread(frames: list[Frame], count: int) -> list[Frame]:
    """At most ``count`` of the frames, evenly spread."""
    if count >= len(frames):
        return list(frames)
    return [frames[int((i + 0.5) * len(frames) / count)] for i in range(count)]

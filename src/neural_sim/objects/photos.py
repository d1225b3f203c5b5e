"""Photographs of objects: one folder for each, with cameras (``transforms.json``, COLMAP's model) or without."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from neural_sim.objects.album import FOLDER, Album, Shot, read_album
from neural_sim.objects.capture import Capture, Frame
from neural_sim.objects.colmap import PLACES, model_folders, read_colmap
from neural_sim.objects.files import Names, choose, content_digest, folder_of
from neural_sim.objects.found import FoundCapture
from neural_sim.objects.mask_command import MaskCommand
from neural_sim.objects.mesh import MeshSource
from neural_sim.objects.pictures import (
    MADE,
    MASKS_FOLDER,
    Box,
    Corners,
    Direction,
    Masks,
    Pictures,
    SceneMaskMaker,
    box_of,
    check_masks,
    given_mask,
    mask_beside,
    mask_of,
    refuse_shared,
    refuse_size,
    saved_box,
)
from neural_sim.objects.placing import AXES, Placement, mean_up, nearest_to_axes, place, upright
from neural_sim.objects.resampling import pixels_per_pixel, resample
from neural_sim.objects.transforms_json import has_transforms, read_transforms
from neural_sim.objects.video import can_be_captured, take_frames
from neural_sim.pictures import read_header, read_picture
from neural_sim.ranges import Matching, NonNegativeInt, Positive, PositiveInt, validated
from neural_sim.types import PosedViews

_log = logging.getLogger(__name__)

Up = (
    Literal["+x", "-x", "+y", "-y", "+z", "-z"]
    | Annotated[Direction, Matching(any, "three numbers, not all of them zero")]
)


class PoseFinder(Protocol):
    """Finds the cameras of photographs."""

    def find(
        self,
        album: Album,
        mask: Callable[[Shot], Bool[np.ndarray, "_ _"] | None],
        progress: bool = False,
    ) -> FoundCapture:
        """Return the cameras; ``mask`` gives the region of a photograph that shows the object, or None.

        Raises:
            ValueError: the cameras cannot be found.
        """
        ...


class PoseCorrector(Protocol):
    """Corrects the poses of an object's photographs."""

    def refine(self, views: PosedViews, held_out: int) -> PosedViews:
        """Return the views at corrected poses; the last ``held_out`` are test frames."""
        ...


@validated
class Photos:
    """Captures in a folder; an object has the name of its folder.

    Args:
        root: the folder that holds the objects' folders, or the folder of one object.
        names: objects to load; null: all.
        masks: source of the objects' masks, see ``Pictures``.
        up: the world's up direction in a capture's frame: ``+x``, ``-x``, ``+y``, ..., or three numbers; or a mapping
            by object name; null: the direction in the capture's file, or else the mean of the cameras' up vectors.
        size: diameter of the bounding sphere in metres, or a mapping by object name; null: unknown.
        box: with ``masks="scene"``: two corners of a box around the object, along the axes of the capture's frame and
            in its unit, or a mapping by object name; null: the box in ``box.json`` in the capture's folder, or else the
            object is searched for where the cameras look.
        scene: computes masks if ``masks="scene"``.
        refinement: corrects the cameras' poses, if given.
        poor: what happens if a field does not show its object in held-out photographs: the run stops before anything
            trains on it (``refuse``), or it is used anyway (``use``).
        poses: finds the cameras if there are only photographs; null: they are given, by ``transforms.json`` or a COLMAP
            model.
        mask_command: with ``masks="command"``: see ``MaskCommand``.
        mask_value: the object's value in label images, or a mapping by object name; null: masks are not label images.
        beside: meshes that are additional objects of the run, under other names; null: none.
        frames: number of frames to take from a video, if cameras must be found and a folder has a video instead of
            photographs.

    Raises:
        ValueError: a folder is missing or has no captures, a name is unknown, ``masks="scene"`` has no ``scene``,
            ``box`` is set without ``masks="scene"``, only one of ``masks="command"`` and ``mask_command`` is set, a
            reader refuses its capture, or a name is also that of a mesh in ``beside``.
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
        refinement: PoseCorrector | None = None,
        poor: Literal["refuse", "use"] = "refuse",
        poses: PoseFinder | None = None,
        mask_command: str | None = None,
        mask_value: NonNegativeInt | Mapping[str, NonNegativeInt | None] | None = None,
        beside: MeshSource | None = None,
        frames: PositiveInt = 60,
    ) -> None:
        self.root, self.poses, self.beside = folder_of(root), poses, beside
        captures = self._found()
        for key, value in {"up": up, "size": size, "box": box, "mask_value": mask_value}.items():
            if isinstance(value, Mapping) and (strange := value.keys() - captures.keys()):
                raise ValueError(
                    f"objects.{key}: {min(strange)!r} is not an object, want some of {', '.join(captures)}"
                )
        self._folders = {name: captures[name] for name in choose(captures, names, {}, str(self.root))}
        self.masks: Masks = masks
        self.up, self.size, self.box, self.scene, self.poor = up, size, box, scene, poor
        self.refinement, self.mask_value, self.frames = refinement, mask_value, frames
        if masks == "scene" and scene is None:
            raise ValueError("objects.masks=scene: want objects.scene, which computes masks, got none")
        if masks != "scene" and box is not None:
            raise ValueError(f"objects.box wants objects.masks=scene, got objects.masks={masks}")
        if (masks == "command") != (mask_command is not None):
            raise ValueError(
                f"objects.mask_command goes with objects.masks=command, got objects.masks={masks} and {mask_command!r}"
            )
        self.command = None if mask_command is None else MaskCommand(mask_command)
        if twice := self._folders.keys() & (() if beside is None else beside.names()):
            raise ValueError(
                f"objects.beside: {min(twice)!r} is also the name of a photographed object; rename its folder"
            )
        self._check()

    def _check(self) -> None:
        """Refuse missing or unsuitable files now, not in a later stage."""
        if self.poses is None:
            for capture in self.captures.values():
                if self.masks in ("auto", "files"):
                    check_masks(capture)
            return
        for album in self.albums.values():
            found: dict[Path, Path] = {}
            for shot in album.shots:
                file = mask_beside(shot.image, album.folder) if self.masks in ("auto", "files") else None
                if file is not None:
                    refuse_size(file, read_header(file).stored, shot.image, shot.size)
                    refuse_shared(found, file, shot.image)

    def _found(self) -> dict[str, Path]:
        """Find the captures' folders by object name: the root if it is an object's folder, else those below it."""
        usable = is_capture if self.poses is None else can_be_captured
        # Programs write more models and photographs into an object's folder, such as colmap/sparse/0 and images_2.
        one = has_transforms(self.root) or any((self.root / place).is_dir() for place in PLACES)
        below = [
            p for p in sorted(self.root.iterdir()) if p.is_dir() and p.name not in (FOLDER, MASKS_FOLDER)
        ]
        captures = {p.name: p for p in below if usable(p)}
        if usable(self.root) and (one or not captures):
            return {self.root.resolve().name: self.root}
        if not captures:
            if self.poses is not None:
                raise ValueError(
                    f"objects.root: {self.root} holds no photographs or video, and no folder with any"
                )
            bare = any(can_be_captured(p) for p in (self.root, *below))
            raise ValueError(
                f"objects.root: {self.root} holds no folder with a transforms.json or a COLMAP model"
                + ("; objects/poses=colmap finds cameras from photographs alone" if bare else "")
            )
        return captures

    def _read(self, name: str) -> Capture:
        folder = self._folders[name]
        return (read_transforms if has_transforms(folder) else read_colmap)(folder, name)

    def names(self) -> list[str]:
        """Return the names of the chosen objects, in their order."""
        return list(self._folders)

    @cached_property
    def captures(self) -> dict[str, Capture]:
        """Frames and cameras by object. Given cameras are read from their files; finding others takes minutes."""
        if self.poses is not None:
            return {name: self.find(name).capture for name in self._folders}
        return {name: self._read(name) for name in self._folders}

    @cached_property
    def albums(self) -> dict[str, Album]:
        """Photographs whose cameras must be found, by object; if there is only a video, frames are taken from it."""
        for name, folder in self._folders.items():
            take_frames(folder, name, self.frames)
        return {name: read_album(folder, name) for name, folder in self._folders.items()}

    def find(
        self, name: str, computed: tuple[Float[Tensor, "_ _"], ...] | None = None, progress: bool = False
    ) -> FoundCapture:
        """Find the cameras of an object's photographs.

        Args:
            name: name of the object.
            computed: its ``command_masks``; None: they are computed here.
            progress: whether to show a progress bar.

        Raises:
            ValueError: the cameras are given, or cannot be found.
        """
        if self.poses is None:
            raise ValueError(f"objects/poses=given: the cameras of {name} are given")
        album = self.albums[name]
        made = self.command_masks(name) if computed is None else computed
        by_image = dict(zip(self.images(name), made, strict=True)) if made else {}

        def mask(shot: Shot) -> Bool[np.ndarray, "_ _"] | None:
            if self.masks in MADE:
                found = by_image.get(shot.image)
            else:
                file = mask_beside(shot.image, album.folder)
                picture = read_picture(shot.image, upright=False)
                found = given_mask(shot.image, file, picture, self.masks, self._value(name))
            return None if found is None else found.numpy() > 0.5

        return self.poses.find(album, mask, progress)

    def with_cameras(self, captures: Iterable[Capture]) -> Photos:
        """Return this source with the captures whose cameras were found."""
        made = copy.copy(self)
        made.captures = {capture.name: capture for capture in captures}
        return made

    def images(self, name: str) -> tuple[Path, ...]:
        """Return all photographs of an object."""
        if self.poses is not None:
            return tuple(shot.image for shot in self.albums[name].shots)
        return tuple(frame.image for frame in self.captures[name].frames)

    def command_masks(self, name: str) -> tuple[Float[Tensor, "_ _"], ...]:
        """Return a mask for each of ``images`` if ``masks="command"``; otherwise none."""
        return () if self.command is None else self.command.masks(self.images(name), self._value(name))

    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of each capture's files, masks included, and of the options that apply to it."""
        return {name: self._digest(name) for name in self._folders}

    def radius(self, name: str) -> float | None:
        """Return the radius of an object's bounding sphere in metres, None if unknown."""
        size = self.size.get(name) if isinstance(self.size, Mapping) else self.size
        return None if size is None else 0.5 * float(size)

    def box_of(self, name: str) -> Corners | None:
        """Return an object's box, if any, for ``masks="scene"``: the one that was set, or else that in its folder."""
        if self.masks != "scene":
            return None
        return box_of(self.box, name) or saved_box(self._folders[name])

    def folder(self, name: str) -> Path:
        """Return the folder of an object's capture."""
        return self._folders[name]

    def split(self, name: str, count: int, held_out: int) -> tuple[list[Frame], list[Frame]]:
        """Return at most ``count`` training frames and ``held_out`` test frames, evenly spread.

        Test frames are the capture's own if it has any; otherwise an eighth of its frames at most, but at least one.

        Raises:
            ValueError: there are fewer than two training frames.
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
        """Compute a mask for each frame of an object's capture if ``masks="scene"``; otherwise none."""
        if self.scene is None or self.masks != "scene":
            return ()
        return self.scene.masks(self.captures[name], self._up(name), self.box_of(name))

    def pictures(self, name: str, computed: tuple[Float[Tensor, "_ _"], ...] | None = None) -> Pictures:
        """Return an object's photographs.

        ``computed`` are its ``command_masks`` or ``computed_masks``; None: they are computed here.
        """
        made = (self.command_masks(name) or self.computed_masks(name)) if computed is None else computed
        if self.command is not None:
            by_image = dict(zip(self.images(name), made, strict=True))
            made = tuple(by_image[frame.image] for frame in self.captures[name].frames)
        return Pictures(self.captures[name], self.masks, made, self._value(name))

    def placement(self, name: str, pictures: Pictures | None = None) -> Placement:
        """Compute an object's pose and radius in its capture's frame."""
        return place(pictures or self.pictures(name), self._up(name), self.box_of(name))

    def views(
        self, name: str, count: int, held_out: int, image_size: int, pictures: Pictures | None = None
    ) -> PosedViews:
        """Resample an object's photographs as views, test frames last, and refine their poses."""
        train, test = self.split(name, count, held_out)
        pictures = pictures or self.pictures(name)
        views = resample(pictures, [*train, *test], self.placement(name, pictures), image_size)
        finest = max(pixels_per_pixel(frame, views.camera) for frame in train)
        _log.info(
            "%s: %d photographs to train on, %d to score; a pixel at views.image_size=%d spans up to %.1f of theirs",
            name, len(train), len(test), image_size, finest,
        )  # fmt: skip
        return views if self.refinement is None else self.refinement.refine(views, len(test))

    def up_of(self, name: str) -> tuple[float, float, float]:
        """Return the up direction in a capture's frame: the one that was set, its file's, or the cameras' mean."""
        capture = self.captures[name]
        return self._up(name) or capture.up or mean_up(capture)

    def directions(self, name: str) -> Float[np.ndarray, "photos 3"]:
        """Compute unit vectors to the cameras, in the object's frame, from its box's centre or where the cameras look.

        No photograph is read: masks would move that point a little, and the directions by a few degrees.
        """
        poses = np.stack([frame.camera_to_world for frame in self.captures[name].frames])
        box = self.box_of(name)
        centre = nearest_to_axes(poses) if box is None else np.array(box).mean(0)
        away = (poses[:, :3, 3] - centre) @ upright(np.array(self.up_of(name)), name).T
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def _up(self, name: str) -> tuple[float, float, float] | None:
        up: Any = self.up.get(name) if isinstance(self.up, Mapping) else self.up
        if up is None:
            return None
        x, y, z = AXES[up] if isinstance(up, str) else up
        return float(x), float(y), float(z)

    def _value(self, name: str) -> int | None:
        return self.mask_value.get(name) if isinstance(self.mask_value, Mapping) else self.mask_value

    def _digest(self, name: str) -> str:
        """Digest the object's files and options, and any cameras that were found."""
        capture, folder = self.captures[name], self._folders[name]
        masks = () if self.masks in MADE else (mask_of(frame, capture.source) for frame in capture.frames)
        files = _named([*capture.files, *(path for path in masks if path is not None)], folder)
        options = f"{self.masks} {self._up(name)} {self.box_of(name)} {self._value(name)} {self.command} "
        if self.poses is not None:
            options += "".join(f"{frame.camera_to_world.tolist()} {frame.lens}" for frame in capture.frames)
        return content_digest({options: Path(), **files})

    def found_digest(self, name: str) -> str:
        """Digest what the search for cameras depends on: the photographs, their masks, and how these are read."""
        options = f"{self.masks} {self._value(name)} {self.command} "
        return content_digest({options: Path(), **self._pictures_and_masks(name)})

    def _pictures_and_masks(self, name: str) -> dict[str, Path]:
        images, folder = self.images(name), self._folders[name]
        beside = () if self.masks in MADE else (mask_beside(image, folder) for image in images)
        return _named([*images, *(path for path in beside if path is not None)], folder)


def _named(files: Iterable[Path], folder: Path) -> dict[str, Path]:
    """Name files by their paths relative to a folder, those elsewhere by their whole paths."""
    return {
        str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path): path for path in files
    }


def is_capture(folder: Path) -> bool:
    """Return whether a folder has the camera files of a capture."""
    return has_transforms(folder) or bool(model_folders(folder))


def _spread(frames: list[Frame], count: int) -> list[Frame]:
    """Return at most ``count`` of the frames, evenly spread."""
    if count >= len(frames):
        return list(frames)
    return [frames[int((i + 0.5) * len(frames) / count)] for i in range(count)]

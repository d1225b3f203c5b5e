"""Stages that prepare photographs for views: cameras found by structure from motion, and computed masks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.objects.capture import Capture, Frame, Lens
from neural_sim.objects.found import FoundCapture
from neural_sim.objects.mask_command import MaskCommand
from neural_sim.objects.photos import Photos, PoseFinder
from neural_sim.objects.pictures import SceneMaskMaker
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.store import from_bytes, to_bytes

MasksOfFrames = tuple[Float[Tensor, "_ _"], ...]


class _StoredMasks(Stage[MasksOfFrames]):
    """Masks of the photographs of an object, stored with 8 bits."""

    phase: ClassVar[str] = "views"
    keep: ClassVar[bool] = False  # large, read once

    @override
    def pack(self, value: MasksOfFrames) -> list[Tensor]:
        return [to_bytes(mask) for mask in value]

    @override
    def unpack(self, stored: list[Tensor]) -> MasksOfFrames:
        return tuple(from_bytes(mask) for mask in stored)


@dataclass(frozen=True)
class CommandMasksStage(_StoredMasks):
    """Masks that another program computes for all photographs of an object.

    Args:
        object: name of the object.
        content: digest of its photographs.
        command: the command that runs the program.
        source: the photographs.
    """

    kind: ClassVar[str] = "command_masks"

    object: str
    content: str
    command: MaskCommand
    source: Photos = field(metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"masks of {self.object} computed by a command"

    @override
    def make(self, results: Results) -> MasksOfFrames:
        return self.source.command_masks(self.object)


@dataclass(frozen=True)
class CamerasStage(Stage[FoundCapture]):
    """The cameras of an object's photographs, computed from the photographs.

    They do not depend on the run's seed, so runs with different seeds share them.

    Args:
        object: name of the object.
        content: digest of the photographs, the masks and their options.
        finder: method that finds the cameras.
        source: the photographs.
        masks: masks computed by a command, which may restrict the search to the object.
        progress: whether to show a progress bar.
    """

    phase: ClassVar[str] = "views"
    kind: ClassVar[str] = "cameras"

    object: str
    content: str
    finder: PoseFinder
    source: Photos = field(metadata=UNKEYED)
    masks: CommandMasksStage | None = None
    progress: bool = field(default=False, metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"cameras of {self.object}"

    @override
    def make(self, results: Results) -> FoundCapture:
        masks = () if self.masks is None else results(self.masks)
        return self.source.find(self.object, masks, self.progress)

    @override
    def pack(self, value: FoundCapture) -> dict[str, Any]:
        images, frames = self.source.images(self.object), value.capture.frames
        return {
            "photographs": [images.index(frame.image) for frame in frames],
            "camera_to_world": torch.from_numpy(np.stack([frame.camera_to_world for frame in frames])),
            "lenses": [list(dataclasses.astuple(frame.lens)) for frame in frames],
            "up": list(value.capture.up or ()),
            "error": value.error,
            "points": value.points,
            "missing": list(value.missing),
            "apart": value.apart,
            "turning": value.turning,
        }

    @override
    def unpack(self, stored: Mapping[str, Any]) -> FoundCapture:
        images, album = self.source.images(self.object), self.source.albums[self.object]
        poses = stored["camera_to_world"].numpy()
        frames = tuple(
            Frame(images[number], pose, _lens(lens))
            for number, pose, lens in zip(stored["photographs"], poses, stored["lenses"], strict=True)
        )
        up = tuple(stored["up"]) or None
        found = FoundCapture(
            Capture(self.object, frames, album.folder, images, up), stored["error"], stored["points"],
            tuple(stored["missing"]), stored["apart"], stored["turning"],
        )  # fmt: skip
        found.tell()
        return found


def _lens(stored: list[Any]) -> Lens:
    width, height, fx, fy, cx, cy, radial, divisor, tangential, fisheye = stored
    return Lens(width, height, fx, fy, cx, cy, tuple(radial), tuple(divisor), tuple(tangential), fisheye)


@dataclass(frozen=True)
class MasksStage(_StoredMasks):
    """Masks of an object's photographs, computed from the scene's geometry; photographs without a camera have none.

    They do not depend on the run's seed, so runs with different seeds share them.

    Args:
        object: name of the object.
        content: digest of the files and options of the capture.
        scene: maker of masks, with its budget.
        source: the captures.
    """

    kind: ClassVar[str] = "masks"

    object: str
    content: str
    scene: SceneMaskMaker
    source: Photos = field(metadata=UNKEYED)

    @property
    @override
    def title(self) -> str:
        return f"masks of {self.object}"

    @override
    def make(self, results: Results) -> MasksOfFrames:
        return self.source.computed_masks(self.object)


def command_masks(source: Photos, name: str) -> CommandMasksStage | None:
    """Return the stage that computes an object's masks with a command, None if no command is set."""
    if source.command is None:
        return None
    return CommandMasksStage(name, source.found_digest(name), source.command, source)


def with_cameras(source: Photos, results: Results, progress: bool = False) -> Photos:
    """Return photographs with their cameras, which are computed if they are not given.

    Cameras are computed first because everything else depends on them, for example the bins that the photographs show
    and the number of usable photographs.

    Raises:
        ValueError: the cameras of some photographs cannot be found.
    """
    finder = source.poses
    if finder is None:
        return source
    stages = (
        CamerasStage(name, source.found_digest(name), finder, source, command_masks(source, name), progress)
        for name in source.names()
    )
    return source.with_cameras([results(stage).capture for stage in stages])

"""Target sets of photographs whose objects' poses are known; readers of a data set's files derive from it."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.digests import digest
from neural_sim.objects.files import content_digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.assembling import Photo, assemble, boxes_by_bin, large_enough
from neural_sim.target.base import Target
from neural_sim.target.frames import Frame, FrameName, Listed, opened
from neural_sim.target.letterbox import letterbox
from neural_sim.target.split import check_fraction, evenly, for_training, split
from neural_sim.target.viewpoint import bins_of_poses
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)

Unmatched = Literal["refuse", "leave_out"]


@dataclass(frozen=True)
class PosedTarget(Target):
    """Photographs with poses, letterboxed to the detector's image size.

    Args:
        root: the data set's folder.
        classes: class name in the data set -> object name, null to leave a class out. Names not listed stand for
            themselves.
        unmatched: what becomes of a class that a photograph shows and that is no object: ``refuse`` the data set, or
            ``leave_out`` its boxes.
        every: of the frames of a scene one in so many is taken, where no list of the data set says which.
        val_fraction: of the photographs, for the part that steers psi, where the data set has no part of its own for
            that: as near to it as whole scenes come, see :func:`neural_sim.target.split.split`.
        train_fraction: of the photographs that are not scored, for training (``training.real``), as near to it as whole
            scenes come; the others steer psi. None: all of them do.
        limit: at most so many photographs in each part, evenly spaced.
        min_visibility: objects of which a smaller fraction is visible have no box.
        minimum_side: boxes with a side shorter than this many pixels after resizing are dropped and counted.

    Raises:
        ValueError: no such folder, a list or a scene that is missing, a number out of its range, fewer than two scenes
            to split.
    """

    renders: ClassVar[bool] = False  # of the objects it takes the names and sizes alone
    root: str | Path
    classes: Mapping[str, str | None] | None = None
    unmatched: Unmatched = "refuse"
    every: int = 50
    val_fraction: float = 0.3
    train_fraction: float | None = None
    limit: int | None = None
    min_visibility: float = 0.1
    minimum_side: float = 2.0

    def __post_init__(self) -> None:
        if not self._root.is_dir():
            raise ValueError(f"target.root: {self._root} is not a folder")
        for key in ("every", "limit"):
            if (value := getattr(self, key)) is not None and value < 1:
                raise ValueError(f"target.{key} must be at least 1, got {value}")
        if not 0.0 < self.val_fraction < 1.0:
            raise ValueError(f"target.val_fraction must lie in (0, 1), got {self.val_fraction}")
        check_fraction(self.train_fraction)
        if not 0.0 <= self.min_visibility <= 1.0:
            raise ValueError(f"target.min_visibility must lie in [0, 1], got {self.min_visibility}")
        if self.unmatched not in get_args(Unmatched):
            raise ValueError(f"target.unmatched must be one of {get_args(Unmatched)}, got {self.unmatched!r}")
        strange = sorted(set(self.classes or {}) - set(self.class_names))
        if strange:
            raise ValueError(
                f"target.classes: {strange} are no classes of {self._root}, which has {self.class_names}"
            )
        self.parts(0)  # refused here rather than after the fields are fitted

    # --- what a reader gives ---

    @property
    @abstractmethod
    def class_names(self) -> list[str]:
        """The data set's classes."""

    @abstractmethod
    def frame(self, name: FrameName, depth: bool = False) -> Frame:
        """One photograph, with its depth where that is asked for.

        Raises:
            ValueError: files that are missing or contradict each other, with the file and what is wrong.
        """

    @abstractmethod
    def _camera(self, name: FrameName) -> PinholeCamera:
        """The camera of one photograph."""

    @abstractmethod
    def _listed(self) -> Listed:
        """The photographs of the set."""

    @abstractmethod
    def _files(self, name: FrameName) -> list[Path]:
        """The files that its labelled image is made from."""

    def _centre(self, class_name: str) -> Float[np.ndarray, "3"] | None:
        """An object's centre in the frame of its poses, in metres; None: the origin."""
        return None

    # --- what a run asks for ---

    @property
    def _root(self) -> Path:
        return Path(self.root).expanduser()

    @cached_property
    def _chosen(self) -> Listed:
        listed = self._listed()
        if not listed.val or (listed.test is not None and not listed.test):
            raise ValueError(f"{self._root}: holds no photographs for {'test' if listed.val else 'val'}")
        scenes = sorted({name.scene for name in listed.val})
        both = sorted(set(scenes) & {name.scene for name in listed.test or ()})
        if both:
            raise ValueError(
                f"{self._root}: scenes {both} are in the part that steers psi and in the part that is scored"
            )
        if listed.test is None and len(scenes) < 2:
            raise ValueError(
                f"{self._root}: want at least two scenes, one for val and one for test, got {scenes}"
            )
        return listed

    @property
    def trains(self) -> bool:
        """Whether some of the photographs are for training."""
        return self.train_fraction is not None

    def training_count(self, seed: int) -> int:
        """How many photographs the part ``train`` has, none of which is read for that."""
        return len(self.parts(seed).get("train", []))

    def parts(self, seed: int) -> dict[str, list[FrameName]]:
        """The photographs of ``val``, which steers psi, ``test`` and any ``train``; they share no scene."""
        listed, generator = self._chosen, torch.Generator().manual_seed(seed)
        scenes = [name.scene for name in listed.val]
        rows, test = list(range(len(scenes))), listed.test
        if test is None:
            val, scored = (part.tolist() for part in split(scenes, self.val_fraction, generator))
            rows, test = val, [listed.val[row] for row in scored]
        unscored = for_training(rows, scenes, self.train_fraction, generator)
        parts = {part: [listed.val[row] for row in own] for part, own in unscored.items()}
        return {part: evenly(sorted(names), self.limit) for part, names in {**parts, "test": test}.items()}

    def camera(self) -> PinholeCamera:
        """The one that took most of the photographs; others are logged.

        Raises:
            ValueError: photographs of several sizes.
        """
        names = [*self._chosen.val, *(self._chosen.test or ())]
        counted = Counter(map(self._camera, names))
        camera, count = counted.most_common(1)[0]
        sizes = {(other.width, other.height) for other in counted}
        if len(sizes) > 1:
            raise ValueError(
                f"{self._root}: camera=from_target wants photographs of one size, got {sorted(sizes)}"
            )
        if count < len(names):
            _log.warning(
                "%s: %d of %d photographs were taken by other cameras than the one that images are synthesised for",
                self._root, len(names) - count, len(names),
            )  # fmt: skip
        return camera

    @cached_property
    def _digest(self) -> str:
        names = sorted({*self._chosen.val, *(self._chosen.test or ())})
        files = sorted({path for name in names for path in self._files(name)})
        contents = content_digest({path.relative_to(self._root).as_posix(): path for path in files})
        return digest({"val": self._chosen.val, "test": self._chosen.test, "files": contents})

    def digest(self) -> str:
        """SHA-256 of which photographs there are and of their files' contents, for store keys."""
        return self._digest

    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """``val``, ``test`` and any ``train``, with the objects' names as classes; takes the arguments of every target
        set.
        """
        radii = {name: item.radius for name, item in objects.items()}
        size, names, made = (camera.height, camera.width), list(objects), {}
        for part, frames in self.parts(seed).items():
            made[part] = self.load(frames, names, *size, distribution, radii)
            _log.info(
                "%s: %s has %d photographs of scenes %s; boxes in each pose bin, from 1: %s", self._root, part,
                len(frames), ", ".join(sorted({frame.scene for frame in frames})), boxes_by_bin(made[part], names),
            )  # fmt: skip
        return made

    def load(
        self,
        names: Sequence[FrameName],
        class_names: Sequence[str],
        height: int,
        width: int,
        distribution: SceneDistribution | None = None,
        radii: Mapping[str, float | None] | None = None,
    ) -> LabelledImages:
        """Any photographs of the data set; labels are positions in ``class_names``.

        With ``distribution`` each box has the bin that its pose falls in, see
        :func:`neural_sim.target.viewpoint.bins_of_poses`, which ``radii`` (metres, by class name) are for.

        Raises:
            ValueError: files that are missing or contradict each other, a class that is no object.
        """
        unknown = sorted({name for name in (self.classes or {}).values() if name} - set(class_names))
        if unknown:
            raise ValueError(f"target.classes: {unknown} are no objects; objects are {list(class_names)}")
        for name in sorted(set(class_names) - {self._object(known) for known in self.class_names}):
            _log.warning("%s: no class for object %s, which gets no score", self._root, name)
        photos, dropped, left_out = [], 0, Counter()
        for name in names:
            frame = self.frame(name)
            photo, small = self._photo(frame, class_names, height, width, distribution, radii or {}, left_out)
            photos.append(photo)
            dropped += small
        if left_out:
            _log.info("%s: boxes of classes that are no objects left out: %s", self._root, dict(left_out))
        if dropped:
            _log.warning("%s: %d boxes shorter than %g px dropped", self._root, dropped, self.minimum_side)
        return assemble(photos)

    def _object(self, class_name: str) -> str | None:
        return (self.classes or {}).get(class_name, class_name)

    def _photo(
        self,
        frame: Frame,
        class_names: Sequence[str],
        height: int,
        width: int,
        distribution: SceneDistribution | None,
        radii: Mapping[str, float | None],
        left_out: Counter[str],
    ) -> tuple[Photo, int]:
        """The letterboxed photograph, and how many of its boxes were too small."""
        with opened(frame.image) as photo:
            image, placing = letterbox(photo, height, width)
        boxes, labels, bins = [], [], []
        for item in frame.objects:
            object_name = self._object(item.name)
            if object_name is not None and object_name not in class_names:
                if self.unmatched == "refuse":
                    raise ValueError(
                        f"{frame.image}: shows {item.name}, which is no object; objects are {list(class_names)}. Map "
                        "it by target.classes, {name: object} or {name: null}, or set target.unmatched=leave_out"
                    )
                left_out[item.name] += 1
                continue
            if object_name is None or item.box is None or item.visibility < self.min_visibility:
                continue
            boxes.append(item.box)
            labels.append(class_names.index(object_name))
            bins.append(self._bin(item.name, item.object_to_camera, distribution, radii.get(object_name)))
        placed = placing.boxes(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4))
        large = large_enough(placed, self.minimum_side)
        kept = [torch.tensor(row, dtype=torch.long)[large] for row in (labels, bins)]
        made = Photo(image, placed[large], kept[0], kept[1] if distribution is not None else None)
        return made, int((~large).sum())

    def _bin(
        self, class_name: str, pose: np.ndarray, distribution: SceneDistribution | None, radius: float | None
    ) -> int:
        if distribution is None:
            return -1
        centre = self._centre(class_name)
        at: Tensor | None = None if centre is None else torch.from_numpy(centre)[None]
        return int(bins_of_poses(distribution, torch.from_numpy(pose)[None], radius, at))

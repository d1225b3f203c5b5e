"""Target sets of photographs with known object poses."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from typing_extensions import override

from neural_sim.digests import digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.ranges import Fraction, PositiveInt
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.base import Photographs, labelled
from neural_sim.target.classes import ClassMap
from neural_sim.target.frames import Frame, FrameName, FrameReader, Listed, PosedObject
from neural_sim.target.photographs import Photograph, read
from neural_sim.target.pose_bins import bins_of_poses
from neural_sim.target.split import evenly, groups_of
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)

Radii = Mapping[str, float | None]


@dataclass(frozen=True)
class PosedTarget(Photographs):
    """Photographs with poses. They are divided before any is read, by scene unless ``split_by`` is given.

    A subclass lists the photographs (``listed``) and provides their ``reader``. ``split_by`` is searched for in
    ``<scene>/<number>``, where BOP's scenes include their folder (``test/000001``); None: the photographs of a scene
    belong together. If a part has more photographs than ``limit``, evenly spaced ones are taken.

    Args:
        root: the data set's folder.
        classes: class name in the data set -> object name, null to leave a class out. Names not listed are the names of
            their objects.
        every: keep every n-th photograph of a scene, unless a list of the data set chooses them.
        min_visibility: objects with a smaller visible fraction have no box.

    See ``Photographs`` for the other arguments.

    Raises:
        ValueError: there is no such folder, a list or a scene is missing, a number is out of its range, or there are
            fewer than two groups to divide.
    """

    root: str | Path
    classes: Mapping[str, str | None] | None = None
    every: PositiveInt = 50
    min_visibility: Fraction = 0.1

    def __post_init__(self) -> None:
        if not self._root.is_dir():
            raise ValueError(f"target.root: {self._root} is not a folder")
        self._class_map.check_listed(self.class_names)
        self.parts(0)  # refused here rather than after the fields are fitted

    @property
    @abstractmethod
    def reader(self) -> FrameReader:
        """The reader of the data set's files."""

    @abstractmethod
    def listed(self) -> Listed:
        """List the photographs of the data set.

        Raises:
            ValueError: a list or a scene is missing or cannot be read.
        """

    @property
    def class_names(self) -> list[str]:
        """The data set's classes."""
        return self.reader.class_names({name.scene for name in self._all})

    # --- which photographs ---

    @property
    def _root(self) -> Path:
        return Path(self.root).expanduser()

    @cached_property
    def _listed(self) -> Listed:
        """The listed photographs, after checking that no part is empty and no scene is in two parts."""
        listed = self.listed()
        if not listed.val or (listed.test is not None and not listed.test):
            raise ValueError(f"{self._root}: holds no photographs for {'test' if listed.val else 'val'}")
        scenes = sorted({name.scene for name in listed.val})
        both = sorted(set(scenes) & {name.scene for name in listed.test or ()})
        if both:
            raise ValueError(
                f"{self._root}: scenes {both} are both in the part for validation and in the part that is scored"
            )
        if listed.test is None and self.split_by is None and len(scenes) < 2:
            raise ValueError(
                f"{self._root}: want at least two scenes, one for val and one for test, got {scenes}"
            )
        return listed

    @property
    def _all(self) -> list[FrameName]:
        return [*self._listed.val, *(self._listed.test or ())]

    @cached_property
    def _groups(self) -> Sequence[Hashable]:
        """The group of each photograph that is not listed for scoring."""
        if self.split_by is None:
            return [name.scene for name in self._listed.val]
        return groups_of(list(map(str, self._listed.val)), self.split_by, self._root)

    def parts(self, seed: int) -> dict[str, list[FrameName]]:
        """Return the photographs of ``val``, ``test`` and any ``train``; no group is in two of them."""
        val, test, generator = self._listed.val, self._listed.test, stream(seed, "target parts")
        if test is None:
            rows = self.split.parts(self._groups, generator)
        else:
            rows = self.split.unscored(range(len(val)), self._groups, generator)
        parts = {part: [val[row] for row in own] for part, own in rows.items()}
        if test is not None:
            parts["test"] = list(test)
        return {part: evenly(sorted(names), self.limit) for part, names in parts.items()}

    @override
    def training_count(self, seed: int) -> int:
        return len(self.parts(seed).get("train", []))

    @override
    def files(self) -> dict[str, Path]:
        names = sorted(set(self._all))
        files = sorted({path for name in names for path in self.reader.files(name)})
        return {path.relative_to(self._root).as_posix(): path for path in files}

    @override
    def digest(self) -> str:
        return digest({"val": self._listed.val, "test": self._listed.test, "files": super().digest()})

    @override
    def camera(self) -> PinholeCamera:
        """Return the camera that took most of the photographs; the log mentions others.

        Raises:
            ValueError: photographs have several sizes.
        """
        names = self._all
        counted = Counter(map(self.reader.camera, names))
        camera, count = counted.most_common(1)[0]
        sizes = {(other.width, other.height) for other in counted}
        if len(sizes) > 1:
            raise ValueError(
                f"{self._root}: camera=from_target needs photographs of one size, got {sorted(sizes)}"
            )
        if count < len(names):
            _log.warning(
                "%s: %d of %d photographs were taken by other cameras than the one of synthesised images",
                self._root, len(names) - count, len(names),
            )  # fmt: skip
        return camera

    # --- what they show ---

    @override
    def sets(
        self,
        objects: Mapping[str, RenderedSubject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
    ) -> dict[str, LabelledImages]:
        radii = {name: item.radius for name, item in objects.items()}
        size, names, made = (camera.height, camera.width), list(objects), {}
        for part, frames in self.parts(seed).items():
            made[part] = self.load(frames, names, *size, distribution, radii)
            _log.info(
                "%s: %s has %d photographs of scenes %s; boxes in each pose bin, from 1: %s", self._root, part,
                len(frames), ", ".join(sorted({frame.scene for frame in frames})), boxes_by_bin(made[part], names),
            )  # fmt: skip
        return labelled(made, self._root)

    def load(
        self,
        names: Sequence[FrameName],
        objects: Sequence[str],
        height: int,
        width: int,
        distribution: SceneDistribution | None = None,
        radii: Radii | None = None,
    ) -> LabelledImages:
        """Read any photographs of the data set; labels are positions in ``objects``.

        With ``distribution`` each box has the bin of its pose, see ``neural_sim.target.pose_bins.bins_of_poses``, which
        needs ``radii`` (metres, by object).

        Raises:
            ValueError: files are missing or contradict each other, or a class is not an object.
        """
        unknown = sorted({name for name in (self.classes or {}).values() if name} - set(objects))
        if unknown:
            raise ValueError(f"target.classes: {unknown} are not objects; objects are {list(objects)}")
        labels = self._class_map.labels(self.class_names, objects)
        photographs, left_out, hidden = [], Counter(), 0
        for name in names:
            frame = self.reader.frame(name)
            left_out.update(self._strange(frame, labels, objects))
            photographs.append(self._photograph(frame, labels, distribution, radii or {}))
            shown = [item for item in frame.objects if labels.get(item.name) is not None]
            hidden += len(shown) - len(photographs[-1].labels)
        if left_out:
            _log.info("%s: boxes of classes that are not objects left out: %s", self._root, dict(left_out))
        if hidden:
            _log.info(
                "%s: %d objects less visible than %g (target.min_visibility) get no box",
                self._root, hidden, self.min_visibility,
            )  # fmt: skip
        return read(photographs, height, width, self.minimum_side, self._root)[0]

    @property
    def _class_map(self) -> ClassMap:
        return ClassMap(self.classes, self._root, unmatched=self.unmatched)

    def _strange(self, frame: Frame, labels: Mapping[str, int | None], objects: Sequence[str]) -> list[str]:
        """List the classes of a photograph's boxes that are not objects, unless these are refused."""
        strange = [item for item in frame.objects if item.name not in labels]
        if strange and self.unmatched == "refuse":
            raise ValueError(
                f"{frame.image}: shows {strange[0].name}, which is not an object; objects are {list(objects)}. Map it "
                "by target.classes, {name: object} or {name: null}, or set target.unmatched=leave_out"
            )
        return [item.name for item in strange if item.box is not None]

    def _photograph(
        self,
        frame: Frame,
        labels: Mapping[str, int | None],
        distribution: SceneDistribution | None,
        radii: Radii,
    ) -> Photograph:
        boxes, own, bins = [], [], []
        for item in frame.objects:
            label = labels.get(item.name)
            if label is None or item.box is None or item.visibility < self.min_visibility:
                continue
            boxes.append(item.box)
            own.append(label)
            try:
                bins.append(self._bin(item, distribution, radii))
            except ValueError as error:
                raise ValueError(f"{frame.image}: pose of {item.name}: {error}") from error
        return Photograph(
            frame.image,
            torch.tensor(own, dtype=torch.long),
            torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
            None if distribution is None else torch.tensor(bins, dtype=torch.long),
        )

    def _bin(self, item: PosedObject, distribution: SceneDistribution | None, radii: Radii) -> int:
        if distribution is None:
            return -1
        centre = self.reader.centre(item.name)
        at: Tensor | None = None if centre is None else torch.from_numpy(centre)[None]
        radius = radii.get(self._class_map.object_of(item.name) or "")
        return int(bins_of_poses(distribution, torch.from_numpy(item.object_to_camera)[None], radius, at))


def boxes_by_bin(images: LabelledImages, names: Sequence[str]) -> str:
    """Return the numbers of boxes of each object in each bin, for the log."""
    counts = [Counter((images.bins[images.labels == label] + 1).tolist()) for label in range(len(names))]
    return "; ".join(
        f"{name} " + ", ".join(f"{b or 'unknown'}: {count}" for b, count in sorted(own.items()))
        for name, own in zip(names, counts, strict=True) if own
    )  # fmt: skip

"""The interface of targets, and the parts that all targets of photographs share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Int
from torch import Tensor
from typing_extensions import override

from neural_sim.objects.files import content_digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.ranges import NonNegative, PositiveInt
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.synthesizer import Synthesizer
from neural_sim.target.classes import Unmatched
from neural_sim.target.photographs import Photograph, read
from neural_sim.target.split import Look, PartOfAll, Split
from neural_sim.types import LabelledImages, PinholeCamera


class Target(ABC):
    """Labelled images in parts: the validation set ``val``, on which psi is learned; ``test``, scored once; ``train``.

    A subclass stores its constructor's arguments as attributes of the same names, as a frozen dataclass does: they are
    the YAML keys of ``target``, and the store's keys are made from them. Bad settings and missing files are refused in
    the constructor, before anything is computed.

    Attributes:
        renders: True if the images are rendered from the run's objects at the distribution that ``parameter.*.target``
            states. False for photographs, whose distribution is unknown unless it is stated.
        boxed: False if images have no boxes, only classes; such a target needs ``task=classification``.
    """

    renders: ClassVar[bool]
    boxed: ClassVar[bool] = True

    @property
    @abstractmethod
    def trains(self) -> bool:
        """Whether there is a part ``train``, on which ``training.real`` trains detectors."""

    @abstractmethod
    def sets(
        self,
        objects: Mapping[str, RenderedSubject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
    ) -> dict[str, LabelledImages]:
        """Read or render the parts. The same arguments give the same images.

        Args:
            objects: the run's objects by name; labels are positions in it.
            distribution: the scene parameters; the bins of boxes are those of its first factor with bins.
            camera: gives the size of the images; a target that renders also uses its field of view and principal point.
            synthesizer: composes rendered views with backgrounds, as for training images.
            seed: seed of all random choices.

        Returns:
            ``val``, ``test`` and, if the target ``trains``, ``train``; float32 on the CPU. They share no image.

        Raises:
            ValueError: files cannot be used, or classes are not objects.
        """

    def training_count(self, seed: int) -> int | None:
        """Return the number of images in ``train``, None if only ``sets`` can tell."""
        return None

    def camera(self) -> PinholeCamera:
        """Return the camera that took the images, with its original image size.

        Raises:
            ValueError: the camera is unknown.
        """
        raise ValueError(
            "camera=from_target needs a target with a camera of its own (target=ycb_video, bop, or coco with an "
            f"entry 'camera' in its file), got {type(self).__name__}"
        )

    def digest(self) -> str | None:
        """Return the SHA-256 of the files from which the images are made, for the store's keys; None without files."""
        return None


@dataclass(frozen=True, kw_only=True)
class Photographs(Target):
    """Labelled photographs, letterboxed to the size of the run's images.

    Args:
        val_fraction: fraction of the photographs in the validation set, on which psi is learned, as near as whole
            groups allow; the others are scored. Has no effect if the data set has parts of its own.
        train_fraction: fraction of the unscored photographs that is for training (``training.real``), also in whole
            groups; the others are for validation. None: all are for validation.
        split_by: what defines the group of a photograph, such as its video; groups stay in one part. See
            ``neural_sim.target.split.groups_of``. None: the data set's own groups; if it has none, every photograph is
            a group of its own, and near-duplicates in two parts give a warning.
        limit: largest number of photographs, counted and chosen as the subclass says; None: all.
        unmatched: what to do with a class of the data set that is not an object: ``refuse`` the data set, or
            ``leave_out`` the class.
        minimum_side: boxes with a side shorter than this, in pixels of the run's images, are dropped and counted.
    """

    renders: ClassVar[bool] = False
    val_fraction: PartOfAll = 0.3
    train_fraction: PartOfAll | None = None
    split_by: str | None = None
    limit: PositiveInt | None = None
    unmatched: Unmatched = "refuse"
    minimum_side: NonNegative = 2.0

    @property
    def split(self) -> Split:
        """How the photographs are divided into parts."""
        return Split(self.val_fraction, self.train_fraction, self.split_by)

    @property
    @override
    def trains(self) -> bool:
        return self.train_fraction is not None

    @abstractmethod
    def files(self) -> Mapping[str, Path]:
        """Return the files from which the images are made, by names that do not depend on their location."""

    @cached_property
    def _contents(self) -> str:
        return content_digest(self.files())

    @override
    def digest(self) -> str:
        return self._contents


@dataclass(frozen=True, kw_only=True)
class AnnotatedPhotographs(Photographs):
    """Photographs with labels of their own, split by group.

    Photographs with equal pixels stay in the same part. A subclass defines ``source``, ``files`` and ``photographs``.
    For the arguments see ``Photographs``.
    """

    @property
    @abstractmethod
    def source(self) -> Path:
        """The file or folder of the data set, for messages."""

    @abstractmethod
    def photographs(
        self, objects: Sequence[str], distribution: SceneDistribution | None = None
    ) -> list[Photograph]:
        """Return the photographs of the data set.

        Args:
            objects: the run's objects in the order of their labels.
            distribution: the scene parameters; pose bins must be bins of its first factor with bins. None: any bins are
                allowed.

        Raises:
            ValueError: labels cannot be used, or classes are not objects.
        """

    def load(self, objects: Sequence[str], height: int, width: int) -> LabelledImages:
        """Read all photographs; labels are positions in ``objects``.

        Raises:
            ValueError: as for ``photographs``, or a file cannot be read.
        """
        return read(self.photographs(objects), height, width, self.minimum_side, self.source)[0]

    @override
    def sets(
        self,
        objects: Mapping[str, RenderedSubject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
    ) -> dict[str, LabelledImages]:
        photographs, generator = self.photographs(list(objects), distribution), stream(seed, "target parts")
        images, placings = read(photographs, camera.height, camera.width, self.minimum_side, self.source)
        looks = [
            Look(photograph.name, photograph.group, image, placing.inside(image))
            for photograph, image, placing in zip(photographs, images.images, placings, strict=True)
        ]
        parts = self.split.parts_by_look(looks, generator, self.source)
        rows = {part: torch.tensor(own) for part, own in parts.items()}
        chosen = self.choose(images, rows, list(objects), distribution, generator)
        return labelled({part: images.select(own) for part, own in chosen.items()}, self.source)

    def choose(
        self,
        images: LabelledImages,
        rows: Mapping[str, Int[Tensor, "_"]],
        objects: Sequence[str],
        distribution: SceneDistribution,
        generator: torch.Generator,
    ) -> Mapping[str, Int[Tensor, "_"]]:
        """Choose some of each part's ``rows``; by default, all of them."""
        return rows


def labelled(parts: dict[str, LabelledImages], source: object) -> dict[str, LabelledImages]:
    """Return the parts of ``source``; raise ``ValueError`` if no photograph in one of them shows an object."""
    empty = [part for part, images in parts.items() if not bool(images.present.any())]
    if empty:
        raise ValueError(
            f"{source}: no photograph of {' or '.join(empty)} has a box of an object; want more photographs of the "
            "objects, or another split"
        )
    return parts

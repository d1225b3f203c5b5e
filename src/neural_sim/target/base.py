"""What a run asks of its target, whatever its images come from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.types import LabelledImages, PinholeCamera


class Target(ABC):
    """Labelled images in parts: ``val``, which psi is learned on, ``test``, which is scored once, and ``train``.

    A subclass keeps its constructor's arguments as attributes of the same names, as a frozen dataclass does: they are
    the YAML keys of ``target``, and the store's keys are made of them. Bad settings and missing files are refused in
    the constructor, before anything is computed.

    Attributes:
        renders: True if the images are rendered from the run's objects at the distribution that ``parameter.*.target``
            states. False for photographs: nobody knows their distribution unless it is stated.
        boxed: False if images have no boxes, only classes; such a target wants ``task=classification``.
    """

    renders: ClassVar[bool]
    boxed: ClassVar[bool] = True

    @property
    @abstractmethod
    def trains(self) -> bool:
        """Whether there is a part ``train``, which ``training.real`` trains detectors on."""

    @abstractmethod
    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """Read or render the parts. The same arguments give the same images.

        Args:
            objects: the run's objects by name; labels are positions in it.
            distribution: the scene parameters; bins of boxes are those of its first factor with bins.
            camera: says the size of the images; a target that renders takes all of it.
            synthesizer: composes rendered views with backgrounds, as it does for training images.
            seed: of all random choices.
            rig: the lights of rendered images; None: the renderer's own.

        Returns:
            ``val``, ``test`` and, if the target :attr:`trains`, ``train``; float32 on the CPU. They share no image.

        Raises:
            ValueError: files that cannot be used, or classes that are no objects.
        """

    def training_count(self, seed: int) -> int | None:
        """Return the number of images in ``train``, None if only :meth:`sets` can tell."""
        return None

    def camera(self) -> PinholeCamera:
        """Return the camera that took the images, in its own size.

        Raises:
            ValueError: no camera is known.
        """
        raise ValueError(
            "camera=from_target wants a target with a camera of its own (target=ycb_video, bop, or coco with an "
            f"entry 'camera' in its file), got {type(self).__name__}"
        )

    def digest(self) -> str | None:
        """Return the SHA-256 of the files that the images are made from, for the store's keys; None without files."""
        return None

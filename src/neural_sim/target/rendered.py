"""The target set of a controlled experiment: the objects themselves, rendered at the target distribution."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.ranges import NonNegativeInt, PositiveInt, validated
from neural_sim.synthesis.layout import draw_layout, own_labels
from neural_sim.synthesis.scene import Scene
from neural_sim.synthesis.subjects import RenderedSubject
from neural_sim.synthesis.synthesizer import Synthesizer, images_without_boxes
from neural_sim.target.base import Target
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)


@validated
@dataclass(frozen=True)
class RenderedTarget(Target):
    """Images rendered at the target distribution; each part has its own random numbers.

    Args:
        val_per_object: number of images of each object for validation, on which psi is learned.
        test_per_object: number of images of each object to score.
        test_per_biased_object: the same for objects that some parameter's ``biased`` names, whose scores are compared.
        train_per_object: number of images of each object that stand in for labelled photographs in training
            (``training.real``); 0: none.
    """

    renders: ClassVar[bool] = True
    val_per_object: PositiveInt = 50
    test_per_object: PositiveInt = 100
    test_per_biased_object: PositiveInt = 200
    train_per_object: NonNegativeInt = 0

    @property
    @override
    def trains(self) -> bool:
        return self.train_per_object > 0

    @override
    def sets(
        self,
        objects: Mapping[str, RenderedSubject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
    ) -> dict[str, LabelledImages]:
        biased, target = set(distribution.biased), distribution.psi("target", list(objects)).float()
        scene = Scene(tuple(objects.values()), camera, synthesizer, distribution)
        parts = {}
        for name in ("val", "test", "train") if self.trains else ("val", "test"):
            generator = stream(seed, f"target {name}")
            counts = [self._count(name, item.name in biased) for item in objects.values()]
            layout = None
            if synthesizer.several:
                layout = draw_layout(own_labels(counts), len(objects), synthesizer.count, generator)
                counts = [len(layout.places(label)[0]) for label in range(len(objects))]
            draws = [
                distribution.hard(psi, distribution.draw_noise(count, generator))
                for count, psi in zip(counts, target, strict=True)
            ]
            parts[name] = scene.images(draws, generator, layout)
            missing = images_without_boxes(parts[name])
            if missing:
                _log.info("target: %d of %d rendered images hold no box", missing, len(parts[name]))
        return parts

    def _count(self, part: str, biased: bool) -> int:
        """Return the number of images drawn for an object; if images show several, others may show it, too."""
        if part != "test":
            return self.val_per_object if part == "val" else self.train_per_object
        return self.test_per_biased_object if biased else self.test_per_object

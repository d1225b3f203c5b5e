"""The target set of a controlled experiment: objects rendered at the target distribution, in disjoint parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.layout import draw_layout, own_labels
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.rendered import render_target
from neural_sim.types import LabelledImages, PinholeCamera


@dataclass(frozen=True)
class RenderedTarget:
    """Images per object in ``val``, from which psi is learned, and in ``test``, which is scored once.

    ``test_per_biased_object`` is for objects named in some parameter's ``biased``, whose scores are compared.
    ``train_per_object`` images stand for labelled photographs in training (``training.real``); 0: none do.
    """

    val_per_object: int = 50
    test_per_object: int = 100
    test_per_biased_object: int = 200
    train_per_object: int = 0

    def __post_init__(self) -> None:
        for name in ("val_per_object", "test_per_object", "test_per_biased_object"):
            if getattr(self, name) < 1:
                raise ValueError(f"target.{name} must be at least 1, got {getattr(self, name)}")
        if self.train_per_object < 0:
            raise ValueError(f"target.train_per_object must be at least 0, got {self.train_per_object}")

    @property
    def trains(self) -> bool:
        """Whether some of the images are for training."""
        return self.train_per_object > 0

    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """``val``, ``test`` and any ``train``, drawn from generators of their own: no pose, background or image is
        shared.
        """
        biased, target = set(distribution.biased), distribution.psi("target", list(objects)).float()
        radii = distribution.radii({name: item.radius for name, item in objects.items()})
        parts = {}
        for name in ("val", "test", "train") if self.trains else ("val", "test"):
            generator = stream(seed, f"target {name}")
            counts = [self._count(name, item.name in biased) for item in objects.values()]
            layout = None
            if synthesizer.several:
                layout = draw_layout(own_labels(counts), len(objects), synthesizer.count, generator)
                counts = [len(layout.places(label)[0]) for label in range(len(objects))]
            draws = []
            for label, (count, psi) in enumerate(zip(counts, target, strict=True)):
                drawn = distribution.hard(psi, distribution.draw_noise(count, generator))
                draws.append(drawn if radii is None else replace(drawn, radius=radii[label]))
            items = list(objects.values())
            parts[name] = render_target(items, draws, camera, synthesizer, generator, rig, layout)
        return parts

    def _count(self, part: str, biased: bool) -> int:
        """Images of an object; of several objects an image, those whose own object it is."""
        if part != "test":
            return self.val_per_object if part == "val" else self.train_per_object
        return self.test_per_biased_object if biased else self.test_per_object

"""The target set of a controlled experiment: objects rendered at the target distribution, in two disjoint parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.rig import LightRig
from neural_sim.renderer.subject import Subject
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.rendered import render_target
from neural_sim.types import LabelledImages, PinholeCamera


@dataclass(frozen=True)
class RenderedTarget:
    """Images per object in ``val``, from which psi is learned, and in ``test``, which is scored once.

    ``test_per_biased_object`` is for objects named in some parameter's ``biased``, whose scores are compared.
    """

    val_per_object: int = 50
    test_per_object: int = 100
    test_per_biased_object: int = 200

    def __post_init__(self) -> None:
        for name in ("val_per_object", "test_per_object", "test_per_biased_object"):
            if getattr(self, name) < 1:
                raise ValueError(f"target.{name} must be at least 1, got {getattr(self, name)}")

    def sets(
        self,
        objects: Mapping[str, Subject],
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """``val`` and ``test``, drawn from generators of their own: no pose, background or image is shared."""
        biased, target = set(distribution.biased), distribution.psi("target", list(objects)).float()
        radii = distribution.radii({name: item.radius for name, item in objects.items()})
        parts = {}
        for part, name in enumerate(("val", "test")):
            generator = torch.Generator().manual_seed(2_000_003 * (seed + 1) + part)
            draws = []
            for label, (item, psi) in enumerate(zip(objects.values(), target, strict=True)):
                test_count = self.test_per_biased_object if item.name in biased else self.test_per_object
                count = test_count if name == "test" else self.val_per_object
                drawn = distribution.hard(psi, distribution.draw_noise(count, generator))
                draws.append(drawn if radii is None else replace(drawn, radius=radii[label]))
            parts[name] = render_target(list(objects.values()), draws, camera, synthesizer, generator, rig)
        return parts

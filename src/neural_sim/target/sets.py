"""The target set of a controlled experiment: meshes rendered at the target distribution, in two disjoint parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from neural_sim.objects.mesh import ObjectMesh
from neural_sim.parameter.pose import Pose
from neural_sim.renderer.base import MeshRenderer
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.rendered import render_target
from neural_sim.types import LabelledImages, PinholeCamera


@dataclass(frozen=True)
class RenderedTarget:
    """Images per object in ``val``, which steers psi, and in ``test``, which is scored once.

    ``test_per_biased_object`` is for objects named in ``parameter.pose.biased``, whose scores are compared.
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
        meshes: Mapping[str, ObjectMesh],
        renderer: MeshRenderer,
        pose: Pose,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
    ) -> dict[str, LabelledImages]:
        """``val`` and ``test``, drawn from generators of their own: no pose, background or image is shared."""
        biased = set(pose.biased or {})
        made = {}
        for part, name in enumerate(("val", "test")):
            generator = torch.Generator().manual_seed(2_000_003 * (seed + 1) + part)
            draws = []
            for item in meshes.values():
                test_count = self.test_per_biased_object if item.name in biased else self.test_per_object
                count = test_count if name == "test" else self.val_per_object
                psi = pose.logits(pose.probabilities("target", item.name))
                draws.append(pose.hard(psi.float(), pose.draw_noise(count, generator)))
            made[name] = render_target(list(meshes.values()), renderer, draws, camera, synthesizer, generator)
        return made

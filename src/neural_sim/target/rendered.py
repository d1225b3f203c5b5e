"""A target set rendered from the meshes themselves at poses drawn from the target distribution."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.parameter.pose import Pose
from neural_sim.renderer.views import MeshRenderer
from neural_sim.synthesis.background import Background
from neural_sim.synthesis.training_set import Synthesizer, images_without_boxes
from neural_sim.types import LabelledImages, PinholeCamera, SceneDraw

_log = logging.getLogger(__name__)

# Views rendered and composed together: bounds the memory, changes no pixel.
CHUNK = 64


@dataclass(frozen=True)
class RenderedTarget:
    """Target images of every object from its mesh, over backgrounds of their own.

    Args:
        val_per_object: images of each object that steer psi.
        test_per_object: images of each object that are scored once, from other draws than those of ``val``.
        background: where backgrounds come from; None takes the training images' source.

    Raises:
        ValueError: fewer than one image of an object in either set.
    """

    val_per_object: int = 50
    test_per_object: int = 200
    background: Background | None = None

    def __post_init__(self) -> None:
        for name in ("val_per_object", "test_per_object"):
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
        """``val`` and ``test``; labels count the objects in the order of ``meshes``."""
        if self.background is not None:
            synthesizer = replace(synthesizer, background=self.background)
        sizes = {"val": self.val_per_object, "test": self.test_per_object}
        made = {}
        for part, (name, count) in enumerate(sizes.items()):
            # A stream for each set, so that the size of one does not change the other.
            generator = torch.Generator().manual_seed(1_000_003 * (seed + 1) + 500_009 + part)
            draws = [target_draw(pose, item, count, generator) for item in meshes]
            made[name] = render_target(
                list(meshes.values()), renderer, draws, camera, synthesizer, generator, pose
            )
        return made


def target_draw(pose: Pose, name: str, count: int, generator: torch.Generator) -> SceneDraw:
    """Hard samples of one object's target distribution."""
    psi = pose.logits(pose.probabilities("target", name))
    return pose.hard(psi, pose.draw_noise(count, generator))


def render_target(
    objects: Sequence[ObjectMesh],
    renderer: MeshRenderer,
    draws: Sequence[SceneDraw],
    camera: PinholeCamera,
    synthesizer: Synthesizer,
    generator: torch.Generator,
    pose: Pose | None = None,
) -> LabelledImages:
    """Images of every object at its draw, object by object; labels are positions in ``objects``.

    With ``pose``, bins are where the poses lie; without, those of the draws. Objects without a box are counted
    in the log. Raises ``ValueError`` for another number of draws than of objects, or none.
    """
    if len(objects) != len(draws) or not objects:
        raise ValueError(
            f"render_target: want one draw per object, got {len(draws)} draws for {len(objects)} objects"
        )
    parts = []
    for label, (item, draw) in enumerate(zip(objects, draws, strict=True)):
        for start in range(0, len(draw), CHUNK):
            here = draw.select(slice(start, start + CHUNK))
            rgb, opacity = _premultiplied(renderer, item, camera, here)
            nuisance = synthesizer.draw_nuisance(len(here), camera, generator)
            bins = here.bins if pose is None else pose.bin_of(here)
            parts.append(synthesizer.compose(rgb, opacity, nuisance, label, bins))
    images = LabelledImages.concatenate(parts)
    missing = images_without_boxes(images)
    if missing:
        _log.info("target: %d of %d rendered images hold no box", missing, len(images))
    return images


def _premultiplied(
    renderer: MeshRenderer, item: ObjectMesh, camera: PinholeCamera, draw: SceneDraw
) -> tuple[Float[Tensor, "n h w 3"], Float[Tensor, "n h w"]]:
    with torch.no_grad():
        rgba = renderer.render(item.mesh, camera, orbit(draw.phi, draw.rho, draw.distance))
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]

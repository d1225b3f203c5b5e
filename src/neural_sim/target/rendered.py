"""Labelled images rendered from the meshes themselves, at given scene parameters."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.cameras import magnified, orbit
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.renderer.base import MeshRenderer
from neural_sim.synthesis.training_set import Synthesizer, images_without_boxes
from neural_sim.types import LabelledImages, PinholeCamera, SceneDraw

_log = logging.getLogger(__name__)

# Views rendered and composed together, which bounds the memory. Part of what a seed means, so not a setting.
CHUNK = 64


def render_target(
    objects: Sequence[ObjectMesh],
    renderer: MeshRenderer,
    draws: Sequence[SceneDraw],
    camera: PinholeCamera,
    synthesizer: Synthesizer,
    generator: torch.Generator,
) -> LabelledImages:
    """Images of every object at its draw, object by object; labels are positions in ``objects``.

    Float32 on the CPU. Images without a box are counted in the log. Raises ``ValueError`` for another number of
    draws than of objects, or none.
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
            parts.append(synthesizer.compose(rgb, opacity, nuisance, label, here.bins[:, 0]))
    images = LabelledImages.concatenate(parts)
    missing = images_without_boxes(images)
    if missing:
        _log.info("target: %d of %d rendered images hold no box", missing, len(images))
    return images


def _premultiplied(
    renderer: MeshRenderer, item: ObjectMesh, camera: PinholeCamera, draw: SceneDraw
) -> tuple[Float[Tensor, "n h w 3"], Float[Tensor, "n h w"]]:
    with torch.no_grad():
        poses = orbit(draw.phi, draw.rho, draw.distance)
        if draw.magnification is None:
            rgba = renderer.render(item.mesh, camera, poses)
        else:  # every image has a camera of its own
            pairs = zip(draw.magnification, poses, strict=True)
            rgba = torch.cat(
                [renderer.render(item.mesh, magnified(camera, float(m)), pose[None]) for m, pose in pairs]
            )
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]

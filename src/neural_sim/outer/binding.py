"""Ties rendered images to what the estimators ask of them: losses by row, and the way back to psi."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.retinanet import Detector, Parameters
from neural_sim.detector.targets import Targets
from neural_sim.gradient.base import Losses, ObjectImages, RenderedPath
from neural_sim.synthesis.scene import RenderedObject, Scene


def image_losses(detector: Detector, backbone: Parameters, targets: Targets) -> Callable[..., Tensor]:
    """Losses of images, differentiable in their pixels: an ``ImageLoss``."""

    def losses(params: Parameters, chunk: Tensor, index: Tensor) -> Tensor:
        return detector.per_image_loss(params, detector.features(backbone, chunk), targets.select(index))

    return losses


def bound_losses(cached: CachedSet, backbone: Parameters, probes: CachedSet | None) -> Losses:
    """Losses of an iteration's training images, from features and from pixels, and of its probes."""
    from_images = image_losses(cached.detector, backbone, cached.targets)
    return Losses(cached.losses, from_images, probes.losses if probes else None)


def rendered_path(scene: Scene, label: int, part: RenderedObject) -> RenderedPath:
    """How one object's images came from psi. Raises ``ValueError`` for images that were not drawn afresh."""
    noise, relaxed = part.noise, part.relaxed
    if noise is None or relaxed is None:
        raise ValueError("pathwise: these images were not drawn from psi afresh")

    def compose(rgb: Tensor, opacity: Tensor) -> Tensor:
        return scene.synthesizer.compose(rgb, opacity, part.nuisance, label, part.draw.bins).images

    return RenderedPath(
        relaxed=lambda psi: scene.pose.relaxed(psi, noise, relaxed.relaxation),
        render_rays=lambda rays: scene.renderer.render_rays(scene.fields[label], rays),
        compose=compose,
        camera=scene.camera,
        rgb=part.rgb,
        opacity=part.opacity,
        tangents=part.tangents,
    )


def object_images(
    scene: Scene, rendered: list[RenderedObject], psi: Tensor, weights: Tensor
) -> dict[str, ObjectImages]:
    """Every object's images by name, with their rows in the joined training set; a path where draws are relaxed."""
    bound, first = {}, 0
    for label, part in enumerate(rendered):
        index = torch.arange(first, first + len(part.images))
        first += len(part.images)
        bound[scene.names[label]] = ObjectImages(
            psi=psi[label].detach().to(part.rgb.dtype),
            log_probabilities=scene.pose.log_probabilities,
            images=part.images.images,
            index=index,
            weights=weights[index],
            draw=part.draw,
            path=rendered_path(scene, label, part) if part.relaxed else None,
            group=part.relaxed.group if part.relaxed else 1,
        )
    return bound

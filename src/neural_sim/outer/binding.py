"""The estimators' inputs from rendered images: losses by row, and the differentiable path from psi to an image."""

from __future__ import annotations

from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.losses import Targets
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.gradient.base import ImageLoss, Losses, ObjectImages, RenderedPath
from neural_sim.synthesis.assembly import Compose, RenderedImages, RenderedObject
from neural_sim.synthesis.scene import Scene
from neural_sim.types import SceneDraw


def image_losses(detector: Detector, backbone: Parameters, targets: Targets) -> ImageLoss:
    """Losses of images, differentiable in their pixels."""

    def losses(params: Parameters, chunk: Tensor, index: Tensor) -> Tensor:
        return detector.per_image_loss(params, detector.features(backbone, chunk), targets.select(index))

    return losses


def bound_losses(cached: CachedSet, backbone: Parameters, probes: CachedSet | None) -> Losses:
    """Losses of an iteration's training images, from features and from pixels, and of its probes."""
    from_images = image_losses(cached.detector, backbone, cached.targets)
    return Losses(cached.losses, from_images, probes.losses if probes else None)


def rendered_path(scene: Scene, label: int, part: RenderedObject, compose: Compose) -> RenderedPath:
    """The path from psi to one object's images through a relaxed draw; ``compose`` makes them of its maps.

    Raises:
        ValueError: images of hard draws.
    """
    noise = part.noise
    if noise is None or part.relaxed is None:
        raise ValueError("pathwise: these images were not drawn from psi by a relaxed draw")

    # All of an object's images are under psi's light.
    light = None if part.draw.weights is None else part.draw.weights[0]

    def replay(psi: Tensor) -> SceneDraw:
        return scene.distribution.relaxed(psi, noise)

    return RenderedPath(
        relaxed=replay,
        render_rays=lambda rays: scene.fields[label].render_rays(rays, light),
        compose=lambda rgb, opacity: compose(rgb, opacity).images,
        camera=scene.camera,
        rgb=part.rgb,
        opacity=part.opacity,
        tangents=part.tangents,
    )


def object_images(
    scene: Scene, rendered: RenderedImages, psi: Tensor, weights: Tensor
) -> dict[str, ObjectImages]:
    """The images in which each object shows, by its name, with their rows in the training set; a path where draws are
    relaxed. ``weights`` are those of all images in the training loss.
    """
    pixels = rendered.images.images
    bound = {}
    for label, (part, rows) in enumerate(zip(rendered.objects, rendered.rows, strict=True)):
        bound[scene.names[label]] = ObjectImages(
            psi=psi[label].detach().to(part.rgb.dtype),
            distribution=scene.distribution,
            images=pixels[rows.to(pixels.device)] if part.relaxed else None,
            index=rows,
            weights=weights[rows],
            draw=part.draw,
            path=rendered_path(scene, label, part, rendered.compose[label]) if part.relaxed else None,
        )
    return bound

"""Inputs of a derivative: losses by row, the path from psi to an image, and a recorded training."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.losses import Targets
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.gradient.base import ImageLoss, Losses, ObjectImages, Probes, RenderedPath
from neural_sim.gradient.reversal import Examples, InputsOf, RecordedTraining
from neural_sim.gradient.unrolled import ProbeGroups
from neural_sim.outer.inner import InnerLoop, Trained
from neural_sim.outer.probing import ProbeSet
from neural_sim.synthesis.assembly import Compose, RenderedImages, RenderedObject
from neural_sim.synthesis.scene import Scene
from neural_sim.types import SceneDraw


def image_losses(detector: Detector, backbone: Parameters, targets: Targets) -> ImageLoss:
    """Return the function that computes losses of images, differentiable in their pixels."""

    def losses(params: Parameters, chunk: Tensor, index: Tensor) -> Tensor:
        return detector.per_image_loss(params, detector.features(backbone, chunk), targets.select(index))

    return losses


def bound_losses(cached: CachedSet, backbone: Parameters, probes: CachedSet | None) -> Losses:
    """Return the functions that compute losses of a training's images, from features and pixels, and of its probes."""
    from_images = image_losses(cached.detector, backbone, cached.targets)
    return Losses(cached.losses, from_images, probes.losses if probes else None)


def rendered_path(scene: Scene, label: int, part: RenderedObject, compose: Compose) -> RenderedPath:
    """Return the path from psi to one object's images through a relaxed draw; ``compose`` makes images from its maps.

    Raises:
        ValueError: the images come from hard draws.
    """
    noise = part.noise
    if noise is None or part.relaxed is None:
        raise ValueError("pathwise: these images were not drawn from psi by a relaxed draw")

    # All images of an object share psi's light.
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
    """Return, by object name, the images that show the object, with their rows in the training set.

    Their pixels and ``path`` are None unless draws are relaxed. ``weights`` has the weights of all drawn images.
    """
    pixels = rendered.images.images
    bound = {}
    for label, (part, rows) in enumerate(zip(rendered.objects, rendered.rows, strict=True)):
        bound[scene.names[label]] = ObjectImages(
            psi=psi[label].detach().to(part.dtype),
            distribution=scene.distribution,
            images=pixels[rows.to(pixels.device)] if part.relaxed else None,
            index=rows,
            weights=weights[rows],
            draw=part.draw,
            path=rendered_path(scene, label, part, rendered.compose[label]) if part.relaxed else None,
        )
    return bound


def recorded(inner: InnerLoop, trained: Trained) -> RecordedTraining:
    """Join a training's recorded steps with its training set.

    Raises:
        ValueError: the training was not recorded.
    """
    if trained.trajectory is None:
        raise ValueError("unrolled: the training was not recorded, want train(..., recording=...)")
    examples = Examples(
        inputs=trained.examples.inputs,
        losses=trained.examples.losses_from,
        proximal=inner.detector.proximal,
        anchor=inner.warm_start,
        inputs_of=inputs_of(inner, trained.examples),
        drawn=None if inner.photographs is None else len(trained.rendered),
    )
    return RecordedTraining(trained.trajectory, examples, trained.trainable)


def probe_groups(probed: ProbeSet, probes: Mapping[str, Mapping[str, Probes]]) -> ProbeGroups:
    """Arrange the probes of learned objects in tables [strata, per_bin], one for each object and factor."""
    tables = [part.index.view(-1, probed.per_bin) for parts in probes.values() for part in parts.values()]
    return ProbeGroups(probed.cached.losses, tables)


def inputs_of(inner: InnerLoop, examples: CachedSet) -> InputsOf:
    """Return the function that computes a training set's inputs from drawn images and their rows."""

    def inputs(pixels: Tensor, rows: Tensor) -> tuple[Tensor, ...]:
        return (*inner.detector.features(inner.backbone, pixels), examples.targets.select(rows).deltas)

    return inputs

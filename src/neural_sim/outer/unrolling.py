"""The psi loop's own way to the derivative of its training: what was recorded, and what is summed over its steps."""

from __future__ import annotations

from collections.abc import Mapping

from jaxtyping import Int
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.accumulated import Accumulated, ProbeGroups
from neural_sim.gradient.base import MixedDerivative, ObjectImages, Probes
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.hypergradient import Hypergradient, InnerProblem, unrolled_hypergradient
from neural_sim.gradient.unrolled import Examples, InputsOf
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.probing import ProbeSet


def through_training(
    loop: InnerLoop,
    problem: InnerProblem,
    estimator: Estimator,
    cached: CachedSet,
    labels: Int[Tensor, "images boxes"],
    images: Mapping[str, ObjectImages],
    probed: ProbeSet | None,
) -> Hypergradient:
    """The derivative of the loop's last training, on ``cached`` images with boxes of these ``labels``.

    ``images`` are those of every object that is learned, ``probed`` the probes of all objects.

    Raises:
        ValueError: where that training was not recorded.
    """
    if loop.trajectory is None:
        raise ValueError("unrolled: the last training was not recorded; want train(images, recording)")
    examples = Examples(
        cached.inputs, cached.losses_from, problem.proximal, problem.anchor, inputs_of(loop, cached, labels)
    )
    probes: dict[str, Mapping[str, Probes]] = {name: {} for name in images}
    groups = None
    if probed is not None:
        probes = {name: probed.probes[loop.scene.names.index(name)] for name in images}
        tables = [part.index.view(-1, probed.per_bin) for held in probes.values() for part in held.values()]
        groups = ProbeGroups(probed.cached.losses, tables)

    def estimate(name: str, found: Accumulated) -> MixedDerivative:
        return estimator.accumulated(found, images[name], probes[name])

    return unrolled_hypergradient(
        problem,
        loop.trajectory,
        examples,
        loop.objective.terms(),
        {name: lambda found, name=name: estimate(name, found) for name in images},
        loop.settings.unrolled,
        loop.generator,
        groups,
        estimator.wanted,
    )


def inputs_of(loop: InnerLoop, cached: CachedSet, labels: Int[Tensor, "images boxes"]) -> InputsOf:
    """A cached set's inputs made again of images, and of their boxes where those are given too."""

    def made(leaves: tuple[Tensor, ...], rows: Tensor) -> tuple[Tensor, ...]:
        pixels, *boxes = leaves
        features = loop.detector.features(loop.backbone, pixels)
        targets = cached.targets.select(rows)
        if boxes:
            targets = loop.detector.assign(boxes[0], labels[rows, : boxes[0].shape[1]])
        return (*features, targets.deltas)

    return made

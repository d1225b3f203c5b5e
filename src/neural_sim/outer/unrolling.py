"""The derivative of the psi loop's last training, from its recorded steps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

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
    images: Mapping[str, ObjectImages],
    probed: ProbeSet | None,
) -> Hypergradient:
    """The derivative of L_val through the loop's last training.

    Args:
        loop: with the recorded training.
        problem: its objective.
        estimator: of the derivative by psi.
        cached: its training set.
        images: those of each learned object.
        probed: the probes of all objects.

    Raises:
        ValueError: that training was not recorded.
    """
    if loop.trajectory is None:
        raise ValueError("unrolled: the last training was not recorded; want train(images, recording)")
    examples = Examples(
        cached.inputs, cached.losses_from, problem.proximal, problem.anchor, inputs_of(loop, cached),
        None if loop.photographs is None else loop.drawn(cached),
    )  # fmt: skip
    probes: dict[str, Mapping[str, Probes]] = {name: {} for name in images}
    groups = None
    if probed is not None:
        probes = {name: probed.probes[loop.scene.names.index(name)] for name in images}
        tables = [part.index.view(-1, probed.per_bin) for parts in probes.values() for part in parts.values()]
        groups = ProbeGroups(probed.cached.losses, tables)

    def estimate(name: str, sums: Accumulated) -> MixedDerivative:
        return estimator.accumulated(sums, images[name], probes[name])

    return unrolled_hypergradient(
        problem,
        loop.trajectory,
        examples,
        loop.differentiated.terms(),
        {name: partial(estimate, name) for name in images},
        loop.settings.unrolled,
        loop.generator,
        groups,
        estimator.wanted,
    )


def inputs_of(loop: InnerLoop, cached: CachedSet) -> InputsOf:
    """The function that computes a cached set's inputs from drawn images and their rows."""

    def inputs(pixels: Tensor, rows: Tensor) -> tuple[Tensor, ...]:
        return (*loop.detector.features(loop.backbone, pixels), cached.targets.select(rows).deltas)

    return inputs

"""The psi loop frozen at one psi and detector, with v solved once, for comparing estimators with a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.gradient.base import Losses, MixedDerivative
from neural_sim.gradient.estimators import by_strata
from neural_sim.gradient.implicit import InnerProblem
from neural_sim.gradient.mixed import scores
from neural_sim.gradient.pathwise import PathwiseEstimator
from neural_sim.outer.derivative import image_losses, object_images
from neural_sim.outer.probing import ProbeSet
from neural_sim.parameter.factor import BinnedFactor
from neural_sim.parameter.product import SceneDistribution
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.hvp import gradient
from neural_sim.solver.operator import unflatten
from neural_sim.synthesis.scene import Scene
from neural_sim.tasks.context import Context
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class State:
    """The state of a psi loop; ``theta`` has all of the detector's parameters."""

    scene: Scene
    detector: Detector
    theta: Parameters
    psi: Float[Tensor, "objects K"]


@dataclass(frozen=True)
class FrozenLoop:
    """The psi loop at one psi and theta, with the adjoint solved once.

    ``trainable`` and ``backbone`` are theta's two parts, ``vector`` is v = (H + lambda I)^-1 dL_val/dtheta, and
    ``solve`` says in words how the solve for v ended.
    """

    scene: Scene
    detector: Detector
    backbone: Parameters
    trainable: Parameters
    vector: Parameters
    psi: Float[Tensor, "objects K"]
    solve: str

    @staticmethod
    def of(context: Context, seed: int) -> FrozenLoop:
        """Return the loop at its start: initial psi, warm-started detector, and v from the run's solver."""
        graph, results, generator = context.graph, context.results, torch.Generator().manual_seed(seed)
        psi, scene = graph.psi("initial"), results(graph.scene)
        images = scene.training_set(psi, context.experiment.loop.outer.images_per_object, generator).images
        theta, validation = results(graph.warm_start).params, results(graph.targets).val
        state = State(scene, graph.warm_start.build(), theta, psi)
        return FrozenLoop.at(state, images, validation, context.experiment.loop.solver, generator)

    @staticmethod
    def at(
        state: State,
        images: LabelledImages,
        validation: LabelledImages,
        solver: AdjointSolver,
        generator: torch.Generator,
    ) -> FrozenLoop:
        """Solve for v with the inner problem of ``images``, which are drawn from the state's psi."""
        scene, detector, psi = state.scene, state.detector, state.psi
        backbone, trainable = detector.split(state.theta)
        cached = CachedSet.of(detector, backbone, images)
        dtype = next(iter(trainable.values())).dtype
        weights = torch.full((len(images),), 1.0 / len(images), dtype=dtype, device=cached.device)
        inner = InnerProblem(trainable, cached.losses, weights)
        terms = CachedSet.of(detector, backbone, validation).mean_terms()
        adjoint = solver.solve(inner.terms(), trainable, gradient(terms, trainable), None, generator)
        solution = adjoint.solution
        ended = solution.status.name.lower().replace("_", " ")
        solve = f"{ended}, {solution.steps} steps at lambda {adjoint.damping.value:.2g}"
        vector = unflatten(solution.value, trainable)
        return FrozenLoop(scene, detector, backbone, trainable, vector, psi, solve)

    def with_factor(self, factor: BinnedFactor) -> FrozenLoop:
        """Return the same state with ``factor``, which has the same bins, as the only factor."""
        distribution = replace(self.scene.distribution, factors=(factor,))
        return replace(self, scene=replace(self.scene, distribution=distribution))

    @property
    def bins(self) -> BinnedFactor:
        """The distribution's only factor, see ``only_bins``."""
        return only_bins(self.scene.distribution)

    def probes(self, per_bin: int, generator: torch.Generator) -> ProbeSet:
        """Draw ``per_bin`` images of every bin of every object."""
        objects = range(len(self.scene.names))
        return ProbeSet.draw(self.scene, self.detector, self.backbone, per_bin, self.psi, generator, objects)

    def truth(self, per_bin: int, generator: torch.Generator) -> list[MixedDerivative]:
        """Estimate every object's derivative over hard bins, from the scores of ``per_bin`` images of each bin."""
        probed, found = self.probes(per_bin, generator), []
        for label, probes in enumerate(probed.probes):
            index = probes[self.bins.name].index
            along = scores(probed.cached.losses, self.trainable, self.vector, index).cpu()
            found.append(by_strata(along, self.bins, self.psi[label].float()))
        return found

    def pathwise(
        self, estimator: PathwiseEstimator, count: int, generator: torch.Generator
    ) -> list[MixedDerivative]:
        """Return every object's estimate from ``count`` relaxed draws of it, made as the psi loop makes them."""
        rendered = self.scene.training_set(self.psi, count, generator, estimator.draws)
        images = rendered.images
        targets = self.detector.assign(images.boxes, images.labels)
        losses = Losses(unavailable, image_losses(self.detector, self.backbone, targets))
        # The weights of an object's images sum to 1.
        weights = torch.full((len(images),), len(rendered.objects) / len(images))
        parts = object_images(self.scene, rendered, self.psi, weights).values()
        return [estimator.estimate(losses, self.trainable, self.vector, part, {}) for part in parts]


def only_bins(distribution: SceneDistribution) -> BinnedFactor:
    """Return the only factor of a distribution.

    Raises:
        ValueError: it has several factors, or its factor has no bins.
    """
    if len(distribution.factors) != 1 or len(distribution.binned) != 1:
        names = [factor.name for factor in distribution.factors]
        raise ValueError(f"parameter: want one parameter with bins to compare estimators in, got {names}")
    return distribution.binned[0]


def check_comparable(context: Context, study: str) -> None:
    """Refuse settings under which a study cannot compare estimators in a frozen loop.

    Raises:
        ValueError: training includes photographs, or the distribution is not of one factor with bins.
    """
    if context.experiment.training.real.combined:
        raise ValueError(f"{study}: want training.real.mode=none, it trains on synthesised images alone")
    only_bins(context.experiment.imaging.distribution)


def pathwise_of(context: Context, study: str) -> PathwiseEstimator:
    """Return the run's estimator.

    Raises:
        ValueError: it is not the pathwise one.
    """
    estimator = context.experiment.loop.gradient
    if not isinstance(estimator, PathwiseEstimator):
        raise ValueError(f"{study}: want gradient=pathwise, the only estimator that differentiates images")
    return estimator


def centred(derivatives: list[MixedDerivative]) -> Float[Tensor, "objects k"]:
    """Return derivatives with respect to centred logits, since adding a constant to all logits does not change p."""
    values = torch.stack([part.value for part in derivatives])
    return values - values.mean(-1, keepdim=True)


def relative_error(value: Tensor, truth: Tensor) -> Tensor:
    """Return |value - truth| / |truth| along the last axis."""
    return (value - truth).norm(dim=-1) / truth.norm(dim=-1)


def unavailable(*_: object) -> NoReturn:
    """Stand in for losses that an estimator does not need."""
    raise AssertionError("an estimator asked for losses of a kind that it does not need")

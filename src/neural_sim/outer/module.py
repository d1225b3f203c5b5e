"""The psi loop of Eq. 1 as a LightningModule: render, train the detector, take the hypergradient, step psi."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from neural_sim.detector.cached import CachedSet
from neural_sim.gradient.base import Losses, ObjectImages, Probes
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.hypergradient import Hypergradient, InnerProblem, hypergradient
from neural_sim.outer.binding import bound_losses, object_images
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.inner import InnerLoop
from neural_sim.outer.probing import ProbeSet
from neural_sim.outer.response import agreement
from neural_sim.outer.unrolling import through_training
from neural_sim.randomness import stream
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.synthesis.assembly import RenderedImages


class SimulatorModule(GradientLoop):
    """psi follows the hypergradient, with a certificate for every iteration."""

    def __init__(
        self, inner: InnerLoop, psi: Float[Tensor, "objects K"], estimator: Estimator, solver: AdjointSolver
    ) -> None:
        super().__init__(inner, psi)
        self.estimator, self.solver = estimator, solver
        self._probes: ProbeSet | None = None
        self._adjoint: Tensor | None = None
        # A generator of its own, so that certifying does not change a run.
        self._check_generator = stream(0, "certificate", inner.generator)
        if self.settings.adjoint == "unrolled":
            self._recording = self.settings.unrolled.recording

    def _derivative(self, rendered: RenderedImages, cached: CachedSet) -> Hypergradient:
        trainable = self.inner.trainable
        drawn, weights, device = len(rendered), self.inner.weights(cached), self.inner.device
        subset, subset_weights = curvature_rows(
            drawn, weights, self.settings.curvature_images, self.inner.generator
        )
        inner = InnerProblem(
            trainable, cached.losses, weights.to(device),
            proximal=self.inner.detector.proximal, anchor=self.inner.warm_start,
            subset=subset.to(device), subset_weights=subset_weights.to(device),
        )  # fmt: skip
        probed, unrolled = self._probes, self.settings.adjoint == "unrolled"
        # Through a training, the fraction of photographs is that of each step's batch, see Examples.drawn.
        own = torch.full((drawn,), 1.0 / drawn) if unrolled else weights[:drawn]
        by_object = object_images(self.scene, rendered, self.psi, own)
        learned = {name: by_object[name] for name in self._names}
        if unrolled:
            return self._with_fixed(
                through_training(self.inner, inner, self.estimator, cached, learned, probed)
            )
        losses = bound_losses(cached, self.inner.backbone, probed.cached if probed else None)
        estimates = {
            name: self._bind(losses, learned[name], probed.probes[label] if probed else {})
            for label, name in zip(self._learned, self._names, strict=True)
        }
        result = hypergradient(
            inner,
            self.inner.differentiated.terms(),
            estimates,
            self.solver,
            self.inner.generator,
            self._adjoint,
        )
        self._adjoint = result.solution.value
        return self._with_fixed(result)

    def _with_fixed(self, result: Hypergradient) -> Hypergradient:
        """Zeros for objects whose psi is fixed, for which nothing was computed."""
        zeros = {name: torch.zeros(self.psi.shape[1]) for name in self.scene.names}
        return replace(
            result,
            psi_gradients={**zeros, **result.psi_gradients},
            standard_errors={**zeros, **result.standard_errors},
        )

    def _bind(self, losses: Losses, images: ObjectImages, probes: dict[str, Probes]) -> Callable:
        trainable = self.inner.trainable
        return lambda vector: self.estimator.estimate(losses, trainable, vector, images, probes)

    def _prepare(self) -> None:
        """Draw probes, or replace a fraction of them, so that the noise of a sample does not bias all iterations."""
        per_bin = self.estimator.probes_per_bin
        if not per_bin:
            return
        if self._probes is None:
            self._probes = self._every_bin(per_bin)
            return
        new = max(1, round(self.settings.refresh * per_bin))
        fresh = self._every_bin(new)
        self._probes = fresh if new == per_bin else self._probes.renewed(fresh, len(self.records))

    def _every_bin(self, per_bin: int) -> ProbeSet:
        """``per_bin`` images of every bin of every factor of the learned objects, with their features."""
        inner = self.inner
        probed = ProbeSet.draw(
            inner.pool or inner.scene,
            inner.detector,
            inner.backbone,
            per_bin,
            self.psi,
            inner.generator,
            self._learned,
        )
        inner.images += len(probed.cached)
        return probed

    @override
    def _cosine(self, result: Hypergradient) -> float:
        """The cosine with the response of training, averaged over objects and factors."""
        return agreement(self.inner, self.psi, result, self._learned)


def curvature_rows(
    drawn: int, weights: Float[Tensor, "N"], wanted: int, generator: torch.Generator
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Rows of the training set for Hessian products, and their weights in them: ``wanted`` random ones (0: all), of the
    first ``drawn``, which were drawn from p_psi, and of the others, which are photographs, in proportion to the weight
    of each part, which its rows keep.
    """
    count, parts = len(weights), []
    if not 0 < wanted < count:
        return torch.arange(count), weights
    for first, last in ((0, drawn), (drawn, count)):
        size, mass = last - first, float(weights[first:last].sum())
        if size == 0:
            continue
        few = min(size, max(1, round(wanted * mass))) if size < count else wanted
        rows = first + torch.randperm(size, generator=generator)[:few]
        parts.append((rows, torch.full((few,), mass / few)))
    rows, scaled = (torch.cat(column) for column in zip(*parts, strict=True))
    return rows, scaled

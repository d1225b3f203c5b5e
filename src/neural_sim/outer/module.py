"""The psi loop of Eq. 1 as a LightningModule: render, train the detector, take the hypergradient, step psi."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.gradient.base import MixedDerivative, ObjectImages, Params, Probes
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.hypergradient import Hypergradient
from neural_sim.gradient.implicit import Implicit, InnerProblem, curvature_rows, hypergradient
from neural_sim.gradient.unrolled import Accumulated, Unrolled
from neural_sim.outer.derivative import bound_losses, object_images, probe_groups, recorded
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.first_step import FirstStep
from neural_sim.outer.inner import InnerLoop, Trained
from neural_sim.outer.objective import Objective
from neural_sim.outer.probing import ProbeSet
from neural_sim.outer.records import Cost
from neural_sim.outer.response import agreement, response
from neural_sim.solver.adjoint import AdjointSolver


class SimulatorModule(GradientLoop):
    """The loop in which psi follows the hypergradient, with a certificate for every iteration."""

    def __init__(
        self,
        inner: InnerLoop,
        psi: Float[Tensor, "objects K"],
        estimator: Estimator,
        solver: AdjointSolver,
        generator: torch.Generator,
        first: FirstStep | None = None,
    ) -> None:
        super().__init__(inner, psi, generator, first)
        self.estimator, self.solver = estimator, solver
        self._probes: ProbeSet | None = None
        self._adjoint: Tensor | None = None
        if isinstance(self.settings.adjoint, Unrolled):
            self._recording = self.settings.adjoint.recording

    @override
    def state(self) -> dict[str, Any]:
        cpu = torch.device("cpu")
        probes, adjoint = self._probes, self._adjoint
        return {
            **super().state(),
            "probes": None if probes is None else probes.state(),
            "adjoint": None if adjoint is None else adjoint.to(cpu),
        }

    @override
    def restore(self, state: Mapping[str, Any]) -> None:
        super().restore(state)
        detector, device, adjoint = self.inner.detector, self.inner.device, state["adjoint"]
        self._probes = None if state["probes"] is None else ProbeSet.of(state["probes"], detector, device)
        self._adjoint = None if adjoint is None else adjoint.to(device)

    @override
    def _derivative(self, trained: Trained, objective: Objective) -> Hypergradient:
        weights, drawn, adjoint = (
            self.inner.weights(trained.examples),
            len(trained.rendered),
            self.settings.adjoint,
        )
        # Drawn for every kind of adjoint, so that later random numbers do not depend on the kind.
        implicit = adjoint if isinstance(adjoint, Implicit) else Implicit()
        subset, own = curvature_rows(drawn, weights, implicit.curvature_images, self.numbers.generator)
        if isinstance(adjoint, Unrolled):
            # Photographs do not count here: each step's batch has its own fraction of them, see Examples.drawn_part.
            images = self._images(trained, torch.full((drawn,), 1.0 / drawn))
            return self._with_fixed(self._through_training(trained, objective, images, adjoint))
        device = self.inner.device
        problem = InnerProblem(
            trained.trainable, trained.examples.losses, weights.to(device),
            proximal=self.inner.detector.proximal, anchor=self.inner.warm_start,
            subset=subset.to(device), subset_weights=own.to(device),
        )  # fmt: skip
        images = self._images(trained, weights[:drawn])
        return self._with_fixed(self._at_stationary_point(trained, objective, images, problem))

    def _images(self, trained: Trained, weights: Float[Tensor, "n"]) -> dict[str, ObjectImages]:
        """Select the images of each free object; ``weights`` are the weights of all drawn images."""
        by_object = object_images(self.scene, trained.rendered, self.psi, weights)
        return {name: by_object[name] for name in self.free.names}

    @property
    def _probes_by_name(self) -> dict[str, Mapping[str, Probes]]:
        probed = self._probes
        named = zip(self.free.names, self.free.labels, strict=True)
        return {name: {} if probed is None else probed.probes[label] for name, label in named}

    def _through_training(
        self,
        trained: Trained,
        objective: Objective,
        images: Mapping[str, ObjectImages],
        adjoint: Unrolled,
    ) -> Hypergradient:
        probes = self._probes_by_name

        def estimate(name: str, sums: Accumulated) -> MixedDerivative:
            return self.estimator.accumulated(sums, images[name], probes[name])

        return adjoint.derivative(
            recorded(self.inner, trained),
            objective.terms(),
            {name: partial(estimate, name) for name in images},
            self.numbers.generator,
            self.estimator.wanted,
            None if self._probes is None else probe_groups(self._probes, probes),
        )

    def _at_stationary_point(
        self,
        trained: Trained,
        objective: Objective,
        images: Mapping[str, ObjectImages],
        problem: InnerProblem,
    ) -> Hypergradient:
        probes, cached = self._probes_by_name, None if self._probes is None else self._probes.cached
        losses = bound_losses(trained.examples, self.inner.backbone, cached)

        def estimate(name: str, vector: Params) -> MixedDerivative:
            return self.estimator.estimate(losses, trained.trainable, vector, images[name], probes[name])

        result = hypergradient(
            problem,
            objective.terms(),
            {name: partial(estimate, name) for name in images},
            self.solver,
            self.numbers.generator,
            self._adjoint,
        )
        self._adjoint = result.adjoint.solution.value
        return result

    def _with_fixed(self, result: Hypergradient) -> Hypergradient:
        """Add zeros for the objects whose psi is fixed."""
        zeros = {name: torch.zeros(self.psi.shape[1]) for name in self.scene.names}
        return replace(
            result,
            gradients={**zeros, **result.gradients},
            errors={**zeros, **result.errors},
        )

    @override
    def _prepare(self) -> None:
        """Draw probes, or replace a fraction of them, so that one sample's noise does not bias all iterations."""
        per_bin = self.estimator.probes_per_bin
        if not per_bin:
            return
        if self._probes is None:
            self._probes = self._every_bin(per_bin)
            return
        new = max(1, round(self.settings.refresh * per_bin))
        fresh = self._every_bin(new)
        self._probes = fresh if new == per_bin else self._probes.renewed(fresh)

    def _every_bin(self, per_bin: int) -> ProbeSet:
        """Draw ``per_bin`` images of every bin of every factor of the free objects, with their features."""
        inner = self.inner
        probed = ProbeSet.draw(
            inner.pool or inner.scene,
            inner.detector,
            inner.backbone,
            per_bin,
            self.psi,
            self.numbers.generator,
            self.free.labels,
        )
        self.charge(Cost(images=len(probed.cached)))
        return probed

    @override
    def _cosine(self, result: Hypergradient) -> float | None:
        found = response(self.inner, self.psi, self.numbers, self.theta)
        self.charge(found.cost)
        return agreement(found.slopes(self.inner, self.psi), self.psi, result, self.free)

"""Stage ``psi``: the distribution that a method learns, with the iterations that led to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.base import Fixed, HypergradientLoop, Response, RewardMethod
from neural_sim.baseline.label_shift.evidence import FactorEstimate, estimates_of
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.detector.classifier import Classifier
from neural_sim.gradient.estimators import Estimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.outer.certificate import Certificate, ImplicitQuality, UnrolledQuality
from neural_sim.outer.evidence import Average
from neural_sim.outer.first_step import Derivative, FirstStep, WhatTheTargetShows
from neural_sim.outer.inner import InnerLoop, LoopInputs, pooled
from neural_sim.outer.loop import OuterLoop, RewardLoop, learn_psi
from neural_sim.outer.module import SimulatorModule
from neural_sim.outer.records import Cost, IterationRecord, LearnedPsi, record_of
from neural_sim.outer.response import ResponseLoop
from neural_sim.outer.settings import Outer
from neural_sim.outer.steps import Verdict
from neural_sim.outer.way import Stay, TakenBack
from neural_sim.parameter.product import HARD, Draws, SceneDistribution
from neural_sim.parameter.update import UpdateState
from neural_sim.randomness import stream
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.pool import PoolStage
from neural_sim.stages.shown import ShownStage, groups_of
from neural_sim.stages.stage import UNKEYED, Results, Stage
from neural_sim.stages.symmetry import SymmetryStage
from neural_sim.stages.target_sets import TargetSetsStage

_STATE = (
    Average, Certificate, FactorEstimate, ImplicitQuality, IterationRecord, Stay, TakenBack, UnrolledQuality,
    UpdateState, Verdict,
)  # fmt: skip
"""Dataclasses that may occur in the state of a loop, see ``OuterLoop.state``."""
Method = Fixed | LabelShift | HypergradientLoop | Response | RewardMethod


@dataclass(frozen=True)
class HypergradientParts:
    """Estimator and solver of a method that follows the hypergradient."""

    estimator: Estimator
    solver: AdjointSolver


@dataclass(frozen=True)
class PsiStage(Stage[LearnedPsi]):
    """The psi that ``method`` learns from the initial distribution.

    ``pool`` has the renders that a loop reuses. ``parts`` is None except for methods that follow the hypergradient.
    ``shown``, the estimate from the target's boxes, is None except for label shift. ``symmetries`` are the groups of
    bins that ``outer.first_step`` cannot tell apart in the boxes. ``on_record`` is called at the end of each iteration
    with its record.

    Raises:
        ValueError: the backbone has fewer stages than ``outer.loop_layers``, or the detector has too many parameters
            for the solver; raised here, before fields are trained.
    """

    phase: ClassVar[str] = "psi"
    kind: ClassVar[str] = "psi"

    warm_start: DetectorStage
    targets: TargetSetsStage
    pool: PoolStage
    distribution: SceneDistribution
    method: Method
    parts: HypergradientParts | None
    outer: Outer
    initial: Float[Tensor, "objects K"]
    seed: int
    shown: ShownStage | None = None
    symmetries: tuple[SymmetryStage, ...] = ()
    on_record: Callable[[IterationRecord], object] | None = field(default=None, metadata=UNKEYED)

    def __post_init__(self) -> None:
        if self.outer.loop_layers:
            self.warm_start.build().in_loop(self.outer.loop_layers)
        largest = None if self.parts is None else self.parts.solver.linear.largest
        if largest is not None and isinstance(self.outer.adjoint, Implicit):
            detector = self.warm_start.build().in_loop(self.outer.loop_layers)
            trained = detector.split(detector.init(torch.Generator()))[1]
            size = sum(value.numel() for value in trained.values())
            if size > largest:
                raise ValueError(
                    f"solver=exact takes up to {largest} unknowns (solver.linear.max_size), but the detector has "
                    f"{size}: want solver=cg or detector=micro"
                )

    @property
    @override
    def title(self) -> str:
        return "psi loop"

    @property
    @override
    def needed(self) -> Iterator[Stage[Any]]:
        if isinstance(self.method, Fixed):
            return iter(())
        return self.inputs if self.shown is None else iter((self.shown,))

    @property
    def draws(self) -> Draws:
        """How images are drawn: as the method's estimator needs them, or as hard draws if it has none."""
        return HARD if self.parts is None else self.parts.estimator.draws

    @override
    def make(self, results: Results) -> LearnedPsi:
        if isinstance(self.method, Fixed):
            psi = self.distribution.psi(self.method.which, list(self.warm_start.scene.names))
            return LearnedPsi(psi[None], [], Cost())
        if self.shown is not None:
            found = results(self.shown)
            spent = Cost(found.images, 0, 0, found.seconds, sum(found.cpu_seconds.values()))
            return LearnedPsi(torch.stack([self.initial, found.psi]), [], spent, found.factors)
        warm_start = results(self.warm_start)
        checkpoint = results.checkpoint(self, _STATE)
        learned = learn_psi(self.loop(results), self.on_record, checkpoint)
        return replace(learned, before=warm_start.cost)

    def loop(self, results: Results) -> OuterLoop:
        """Return the loop of the method, not yet run.

        Raises:
            ValueError: the method has no loop.
        """
        method, scene, training = self.method, results(self.warm_start.scene), self.warm_start.training
        detector, params = self.warm_start.build(), results(self.warm_start).params
        photographs = self.warm_start.photographs(results)
        pool = results(self.pool) if pooled(self.outer, self.draws, self.distribution) else None
        inputs = LoopInputs(detector, params, results(self.targets).val, photographs, pool)
        generator = stream(self.seed, "psi")
        inner = InnerLoop.prepare(scene, inputs, self.outer, training, generator, self.draws)
        if self.parts is not None:
            first = self._first_step(results, isinstance(detector, Classifier))
            return SimulatorModule(
                inner, self.initial, self.parts.estimator, self.parts.solver, generator, first
            )
        if isinstance(method, Response):
            return ResponseLoop(inner, self.initial, method.part, generator)
        if isinstance(method, (Fixed, LabelShift, HypergradientLoop)):
            raise ValueError(f"baseline={method.name} has no outer loop")
        return RewardLoop(inner, self.initial, method, generator)

    def _first_step(self, results: Results, whole: bool) -> FirstStep | None:
        """Return the proposal for the loop's first step, None if that step follows the derivative."""
        settings = self.outer.first_step
        if isinstance(settings, Derivative):
            return None
        settings = settings.for_target(self.targets.target.renders)
        return WhatTheTargetShows(settings, groups_of(self.symmetries, results), whole)

    @override
    def pack(self, value: LearnedPsi) -> dict[str, Any]:
        return {
            "trajectory": value.trajectory,
            "records": [dataclasses.asdict(record) for record in value.records],
            "before": dataclasses.asdict(value.before),
            "shown": [dataclasses.asdict(one) for one in value.shown],
        }

    @override
    def unpack(self, stored: Mapping[str, Any]) -> LearnedPsi:
        records = [record_of(record) for record in stored["records"]]
        shown = estimates_of(stored["shown"])
        return LearnedPsi(stored["trajectory"], records, Cost(**stored["before"]), shown)

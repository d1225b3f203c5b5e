"""Stage ``shown``: the psi estimated from the target's boxes, before any detector is trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.baseline.label_shift.estimate import Estimate, Groups, estimate
from neural_sim.baseline.label_shift.evidence import estimates_of
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.parameter.product import SceneDistribution
from neural_sim.randomness import stream
from neural_sim.stages.pool import PoolStage
from neural_sim.stages.stage import Results, Stage
from neural_sim.stages.symmetry import SymmetryStage
from neural_sim.stages.target_sets import TargetSetsStage


@dataclass(frozen=True)
class ShownStage(Stage[Estimate]):
    """The label-shift estimate from the target's validation images.

    ``symmetries`` are the groups of bins that look the same; ``psi`` is the current psi, which the estimate is tested
    against; with ``whole``, whole images are read instead of boxes, which a classifier's images do not have.
    """

    phase: ClassVar[str] = "psi"
    kind: ClassVar[str] = "shown"

    pool: PoolStage
    targets: TargetSetsStage
    symmetries: tuple[SymmetryStage, ...]
    distribution: SceneDistribution
    settings: LabelShift
    psi: Float[Tensor, "objects K"]
    whole: bool
    seed: int

    @property
    @override
    def title(self) -> str:
        return "what the target shows"

    @override
    def make(self, results: Results) -> Estimate:
        groups = groups_of(self.symmetries, results)
        pool, validation = results(self.pool), results(self.targets).val
        generator = stream(self.seed, "psi")
        generator.set_state(pool.state)
        settings = self.settings.for_target(self.targets.target.renders)
        found = estimate(pool.scene, validation, self.psi, settings, generator, groups, self.whole)
        spent = {**found.cpu_seconds, "pool": found.cpu_seconds["pool"] + pool.spent.cpu_seconds}
        return replace(found, seconds=found.seconds + pool.spent.seconds, cpu_seconds=spent)

    @override
    def pack(self, value: Estimate) -> dict[str, Any]:
        return {**vars(value), "factors": [dataclasses.asdict(one) for one in value.factors]}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> Estimate:
        return Estimate(**{**stored, "factors": estimates_of(stored["factors"])})


def groups_of(symmetries: Sequence[SymmetryStage], results: Results) -> Groups:
    """Return the groups of bins that look the same, by object and angle."""
    groups: dict[str, dict[str, list[list[int]]]] = {}
    for stage in symmetries:
        groups.setdefault(stage.object, {})[stage.angle] = results(stage)
    return groups

"""Stage ``evaluate``: scores of trained detectors on target images."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import Tensor
from typing_extensions import override

from neural_sim.detector.metrics import TestScore, evaluate, of_document, worthless
from neural_sim.stages.detector import TrainedStage
from neural_sim.stages.stage import Results, Stage
from neural_sim.stages.target_sets import TargetSetsStage

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scores:
    """Average precision or accuracy on a part of the target sets, and the detections in every image."""

    ap: TestScore
    detections: list[dict[str, Tensor]]


@dataclass(frozen=True)
class ScoresStage(Stage[Scores]):
    """Scores of a detector on ``part`` of the target sets."""

    phase: ClassVar[str] = "evaluate"
    kind: ClassVar[str] = "evaluate"

    trained: TrainedStage
    targets: TargetSetsStage
    part: Literal["val", "test"] = "test"

    @property
    @override
    def title(self) -> str:
        return f"{self.part} scores of the {self.trained.title}"

    @override
    def make(self, results: Results) -> Scores:
        params, images = results(self.trained).params, getattr(results(self.targets), self.part)
        detector = self.trained.build()
        detections = detector.predict(params, images.images)
        return Scores(evaluate(detections, images, list(self.trained.names), detector.score), detections)

    @override
    def pack(self, value: Scores) -> dict[str, Any]:
        return {"ap": dataclasses.asdict(value.ap), "detections": value.detections}

    @override
    def unpack(self, stored: Mapping[str, Any]) -> Scores:
        scores = Scores(of_document(stored["ap"]), stored["detections"])
        if (why := worthless(scores.ap, scores.detections)) is not None:
            _log.warning("%s: %s", self.title, why)
        return scores

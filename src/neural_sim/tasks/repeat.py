"""Task ``repeat``: the scored detectors trained again with other random numbers, and how much of the gain remains."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neural_sim.checks import at_least
from neural_sim.report.bootstrap import Outcomes, match
from neural_sim.report.repeat import Repeated, repeated, sentence, table
from neural_sim.stages.detector import DetectorStage, PhotographsStage, TrainedStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.tasks.context import Context

APART = 1_000
"""Between the seeds of trainings, so that a sweep over seeds 0, 1, 2 shares none of them."""


@dataclass(frozen=True)
class RepeatTask:
    """Detectors of the initial, the learned and the target's distribution, each trained several times.

    The first training is the run's own. The target's is left out where it is unknown or where the run starts at it.
    Fields, psi and test images stay as they are. Where some of the photographs train too, each training chooses its
    own.

    Args:
        trainings: of each distribution, at least 2.
        draws: of the bootstrap over test images.

    Raises:
        ValueError: numbers below their least.
    """

    trainings: int = 5
    draws: int = 100

    needs = ("views", "field", "target_sets", "warm_start", "psi", "evaluate")

    def __post_init__(self) -> None:
        at_least("repeat", 2, trainings=self.trainings, draws=self.draws)

    def run(self, context: Context) -> None:
        """Write repeat.md, which is also printed, and repeat.json."""
        graph, results, score = context.graph, context.results, context.experiment.score
        names, test = list(graph.names), results(graph.targets).test
        first = graph.compared(results(graph.learned))
        if "matched" in first and first["matched"].key == first["ns"].key:
            del first["matched"]  # the run starts at the target's distribution
        wanted = [(w, k) for w in ("ns", "learned", "matched") if w in first for k in range(self.trainings)]
        matches: dict[str, list[list[Outcomes]]] = {}
        for which, k in context.shown(wanted, "repeat"):
            detections = results(again(first[which], k)).detections
            row = [match(detections, test, label, score) for label in range(len(names))]
            matches.setdefault(which, []).append(row)
        shown = [label for label, each in enumerate(matches["ns"][0]) if each.boxes_per_image.sum()]
        biased = context.experiment.imaging.distribution.biased
        found = repeated(matches, groups(names, biased, shown), self.draws)
        text = f"{sentence(found[0], score)}\n\n{table(found, score)}\n"
        (context.folder / "repeat.md").write_text(text, encoding="utf-8")
        document = {
            "trainings": self.trainings,
            "score": score,
            "groups": [_document(each) for each in found],
        }
        (context.folder / "repeat.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
        print(f"{text}results: {context.folder}")


def groups(
    names: Sequence[str], biased: Container[str], shown: Sequence[int]
) -> list[tuple[list[str], list[int]]]:
    """Return names and labels of the objects that a run is about, of all objects, and of each one.

    Objects that no test image shows are left out.
    """
    about = [label for label in shown if names[label] in biased]
    found: list[list[int]] = []
    for group in (about or [*shown], [*shown], *([label] for label in shown)):
        if group not in found:
            found.append(group)
    return [([names[label] for label in group], group) for group in found]


def again(stage: ScoresStage, training: int) -> ScoresStage:
    """Return the same scores of a detector with other random numbers; training 0 is the run's."""
    return replace(stage, trained=_seeded(stage.trained, APART * training))


def _seeded(stage: TrainedStage, by: int) -> TrainedStage:
    if isinstance(stage, PhotographsStage):
        start = None if stage.start is None else replace(stage.start, seed=stage.start.seed + by)
        return replace(stage, seed=stage.seed + by, start=start)
    if isinstance(stage, DetectorStage):
        return replace(stage, seed=stage.seed + by)
    raise TypeError(f"repeat: a training that has no seed, {type(stage).__name__}")


def _document(group: Repeated) -> dict[str, Any]:
    ahead = {f"{a} - {b}": dataclasses.asdict(estimate) for (a, b), estimate in group.ahead.items()}
    return dataclasses.asdict(group) | {"ahead": ahead}

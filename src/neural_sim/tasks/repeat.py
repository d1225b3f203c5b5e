"""Task ``repeat``: retrain the scored detectors with other random numbers to see how much of the gain remains."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

from annotated_types import Ge
from typing_extensions import override

from neural_sim.detector.protocol import Score
from neural_sim.documents import markdown_table, write_json, write_whole
from neural_sim.ranges import validated
from neural_sim.report.intervals import points
from neural_sim.report.page.verdict import Gain, verdict
from neural_sim.report.run import CALLED
from neural_sim.report.score_table import Outcomes, ScoreTable, match
from neural_sim.stages.detector import DetectorStage, PhotographsStage, TrainedStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task

APART = 1_000
"""Distance between the seeds of trainings, so that runs with seeds 0, 1, 2 of a sweep share none."""
SHOWN = (("learned", "ns"), ("matched", "learned"))
"""Differences in a table, as pairs of detectors: the first minus the second."""
DIFFERENCES = (*SHOWN, ("matched", "ns"))
Several = Annotated[int, Ge(2)]


@validated
@dataclass(frozen=True)
class RepeatTask(Task):
    """Detectors of the initial, the learned and the target distribution, each trained several times.

    The first training is the run's own. The target distribution is left out if it is unknown or if the run starts from
    it. Fields, psi and test images do not change. If training uses a subset of photographs, each training chooses its
    own.

    Args:
        trainings: number of trainings on each distribution.
        draws: bootstrap draws over test images.
    """

    trainings: Several = 5
    draws: Several = 100

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        return [graph.learned, graph.scores(graph.psi("initial"), "ns")]

    @override
    def run(self, context: Context) -> None:
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
        scores = ScoreTable.of(matches, names, self.draws)
        biased = context.experiment.imaging.distribution.biased
        found = [scores.of_classes(group) for group in groups(names, biased, scores.shown)]
        text = f"{sentence(found[0], score)}\n\n{table(found, score)}\n"
        write_whole(context.folder / "repeat.md", text)
        document = {"trainings": self.trainings, "score": score, "groups": [group_document(g) for g in found]}
        write_json(context.folder / "repeat.json", document)
        print(f"{text}results: {context.folder}")


def groups(names: Sequence[str], biased: Container[str], shown: Sequence[str]) -> list[list[str]]:
    """Return groups of objects that test images show: the biased ones, all of them, and each one alone."""
    known = [name for name in names if name in shown]
    about = [name for name in known if name in biased]
    found: list[list[str]] = []
    for group in (about or known, known, *([name] for name in known)):
        if group not in found:
            found.append(group)
    return found


def sentence(scores: ScoreTable, score: Score) -> str:
    """Return the verdict on the learned distribution over several trainings."""
    trainings = scores.point.shape[1]
    text = verdict(Gain.of(scores), score, trainings)
    return f"After {trainings} trainings of each distribution: {text}"


def table(found: Sequence[ScoreTable], score: Score) -> str:
    """Return a Markdown table with one row per group, in points; differences whose interval excludes 0 are bold."""
    which = found[0].detectors
    differences = [(a, b) for a, b in SHOWN if {a, b} <= set(which)]
    head = [
        "",
        *(CALLED[detector] for detector in which),
        *(f"{CALLED[a]} minus {CALLED[b]}" for a, b in differences),
        "between trainings",
        "over test images",
    ]
    rows = []
    for scores in found:
        names, scatter = scores.classes, scores.scatter()
        rows.append(
            [
                names[0] if len(names) == 1 else "mean of " + ", ".join(names),
                *(points(scores.mean(detector)) for detector in which),
                *(points(scores.ahead(a, b), sure=True) for a, b in differences),
                f"{100 * scatter.seeds:.1f}",
                f"{100 * scatter.images:.1f}",
            ]
        )
    note = (
        f"{score[0].upper()}{score[1:]} on the test set in points, means of {found[0].point.shape[1]} trainings, with "
        "95 % intervals over trainings and test images. Differences whose interval excludes 0 are bold. The last two "
        "columns are standard deviations of one detector's score: between trainings on one distribution, and over test "
        "images."
    )
    return f"{markdown_table(head, rows)}\n\n{note}"


def group_document(scores: ScoreTable) -> dict[str, Any]:
    """Return the entry of a group in repeat.json; scores are fractions."""
    which, scatter = scores.detectors, scores.scatter()
    pairs = [(a, b) for a, b in DIFFERENCES if {a, b} <= set(which)]
    return {
        "names": scores.classes,
        "scores": {detector: scores.sample(detector)[0].tolist() for detector in which},
        "mean": {detector: dataclasses.asdict(scores.mean(detector)) for detector in which},
        "ahead": {f"{a} - {b}": dataclasses.asdict(scores.ahead(a, b)) for a, b in pairs},
        "between": scatter.seeds,
        "over_images": scatter.images,
    }


def again(stage: ScoresStage, training: int) -> ScoresStage:
    """Return the same scores for a detector trained with other random numbers; training 0 is the run's own."""
    return replace(stage, trained=_seeded(stage.trained, APART * training))


def _seeded(stage: TrainedStage, by: int) -> TrainedStage:
    if isinstance(stage, PhotographsStage):
        start = None if stage.start is None else replace(stage.start, seed=stage.start.seed + by)
        return replace(stage, seed=stage.seed + by, start=start)
    if isinstance(stage, DetectorStage):
        return replace(stage, seed=stage.seed + by)
    raise TypeError(f"repeat: {type(stage).__name__} has no seed")

"""Task ``preflight``: estimate whether an optimisation is worth running, and compare renders with the target."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from typing_extensions import override

from neural_sim.baseline.base import HypergradientLoop, Response
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.documents import write_json
from neural_sim.outer.descent import GradientLoop
from neural_sim.outer.preflight import expected_gains, photograph_gains
from neural_sim.ranges import PositiveFraction, PositiveInt, validated
from neural_sim.report.page.preflight import Preflight, write_preflight_page
from neural_sim.report.page.weak_bins import bin_scores
from neural_sim.report.provenance import caution
from neural_sim.stages.stage import Stage
from neural_sim.target.mismatch import distance_factor, matching_settings, mismatches
from neural_sim.tasks.context import Context, Task


@validated
@dataclass(frozen=True)
class PreflightTask(Task):
    """What to expect from an optimisation, before running one.

    Shows the scores of the initial distribution's detector by bin of the validation images, the expected gain of every
    object and bin to first order, and how renders differ from the target.

    Args:
        trials: number of trainings whose derivatives are averaged.
        moved: fraction of an object's images that is moved to a bin to estimate the gain of that bin.
        labelled: numbers of labelled training photographs whose gain is measured for comparison, if the target has any
            to train on.
    """

    trials: PositiveInt = 2
    moved: PositiveFraction = 0.15
    labelled: Sequence[PositiveInt] = (10, 25)

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        method, graph = context.experiment.loop.method, context.graph
        if not isinstance(method, (HypergradientLoop, Response)):
            raise ValueError(
                f"preflight wants a method that follows the hypergradient or the response, got baseline={method.name}"
            )
        return [graph.targets, graph.shown, graph.warm_start, graph.of_initial]

    @override
    def run(self, context: Context) -> None:
        graph, results, x = context.graph, context.results, context.experiment
        for stage in context.shown(self.reads(context), "preflight"):
            results(stage)
        names, validation = list(graph.names), results(graph.targets).val
        loop = cast(GradientLoop, graph.learned.loop(results))
        outer = x.loop.outer
        foreseen = expected_gains(loop, self.trials, self.moved)
        photographs, labelled = results(graph.targets).train, []
        if photographs is not None and self.labelled:
            labelled = photograph_gains(loop, photographs, self.labelled, self.trials, x.run.seed)
        detections = graph.of_initial.build().predict(results(graph.of_initial).params, validation.images)
        images = graph.of_initial.images(results).images.to("cpu")
        differ = mismatches(validation, images)
        level = 0.05 if outer.trust.level is None else outer.trust.level
        report = Preflight(
            experiment=x.run.name,
            names=tuple(names),
            foreseen=tuple(foreseen),
            level=level,
            bins=tuple(bin_scores(names, {"ns": detections}, validation, score=x.score)),
            mismatches=tuple(differ),
            settings=matching_settings(validation, images, differ),
            distance_factor=distance_factor(differ),
            labelled=tuple(labelled),
            score=x.score,
            shown=results(graph.shown).factors,
            follows=isinstance(outer.first_step, LabelShift),
            caution=caution(context.scale),
        )
        document = dataclasses.asdict(report) | {"verdict": report.verdict, "worth": report.worth}
        write_json(context.folder / "preflight.json", document)
        bins = {stage.object: results(stage).bins for stage in graph.qualities}
        page = write_preflight_page(report, validation, images, context.folder, bins)
        print(report.summary())
        print(f"is it worth it? open {page}")

"""A run: the phases and tasks that ``stages=[...]`` lists, in order, with everything that they need."""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from typing_extensions import override

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.outer.inner import pooled
from neural_sim.parameter.product import HardDraws
from neural_sim.report.page.objects import ShownObject, write_objects_page
from neural_sim.report.run_tracking import LiveRun
from neural_sim.stages.account import Omission
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task
from neural_sim.tasks.forecast import forecast
from neural_sim.tasks.report import ReportTask

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Phase(Task):
    """A phase of a run, consisting of stages that are known before it starts.

    Args:
        name: name of the phase.
        stages: returns the stages whose results the phase consists of.
        log: logs a result to MLflow.
    """

    name: str
    stages: Callable[[Graph], Iterable[Stage[Any]]]
    log: Callable[[LiveRun, Any, Any], None] | None = None

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        return self.stages(context.graph)

    @override
    def run(self, context: Context) -> None:
        stages = context.together(self.stages(context.graph))
        for stage in context.results.free_first(context.shown(stages, self.name)):
            result = context.results(stage)
            if context.live and self.log:
                self.log(context.live, stage, result)


@dataclass(frozen=True)
class FieldPhase(Phase):
    """The phase that fits the fields and writes a page that says whether they show their objects."""

    @override
    def run(self, context: Context) -> None:
        super().run(context)
        graph = context.graph
        shown = [
            ShownObject(
                stage.object,
                context.results(stage),
                not graph.objects.part(stage.object).has_meshes,
                graph.experiment.imaging.coverage.get(stage.object, {}),
            )
            for stage in graph.qualities
        ]
        page = write_objects_page(context.experiment.run.name, shown, context.folder)
        for each in shown:
            if each.poor:
                _log.warning("%s: %s; see %s", each.name, each.verdict, page)
        scores = [each.quality.psnr for each in shown if each.quality.psnr is not None]
        if len(shown) == 1:
            said = f"{shown[0].name}: {shown[0].verdict}"
        elif scores:
            said = f"{min(scores):.1f} to {max(scores):.1f} dB on {len(scores)} objects in held-out views"
        else:
            said = "no views are held out to score them"
        _log.info("fields: %s; see %s", said, page)


@dataclass(frozen=True)
class EvaluateTask(Task):
    """The scores of the detectors that a run compares."""

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        return [graph.learned, graph.scores(graph.psi("initial"), "ns")]

    @override
    def run(self, context: Context) -> None:
        learned = context.results(context.graph.learned)
        stages = context.together(context.graph.evaluated(learned))
        for stage in context.results.free_first(context.shown(stages, "evaluate")):
            context.results(stage)


PHASES: Mapping[str, Task] = {
    "views": Phase("views", lambda graph: graph.views),
    "field": FieldPhase(
        "field",
        lambda graph: graph.fields,
        lambda live, stage, fitted: live.fields({stage.views.object: fitted.history}),
    ),
    "target_sets": Phase("target_sets", lambda graph: [graph.targets]),
    "warm_start": Phase("warm_start", lambda graph: graph.read_warm_start),
    "psi": Phase(
        "psi",
        lambda graph: [graph.learned],
        lambda live, _, learned: live.iterations([dataclasses.asdict(each) for each in learned.records]),
    ),
    "evaluate": EvaluateTask(),
    "report": ReportTask(),
}
"""The phases of a run from objects to a report, in order."""


def walk(context: Context, tasks: Mapping[str, Task]) -> float | None:
    """Run tasks in order; results that the store lacks are made when a task first asks for them.

    Stages that the tasks know they will read are checked before anything is made.

    Returns:
        The objective for a sweep to maximise: the score on validation images of the detector trained on the learned
        distribution. None if nothing was evaluated.
    """
    phases = PHASES.keys() & tasks.keys()
    if phases:
        warn_of_uncovered(context.graph)
    if {"psi", "evaluate", "report"} & phases or "preflight" in tasks:
        warn_of_misreading(context.graph)
    wanted = [stage for task in tasks.values() for stage in task.reads(context)]
    if wanted:
        missing = [stage for stage in context.results.check(wanted) if stage.stored]
        counts = Counter(stage.phase for stage in missing)
        _log.info(
            "to make: %s%s",
            ", ".join(f"{phase} {count}" for phase, count in counts.items()) or "nothing",
            forecast(context, missing),
        )
    if phases:
        context.account.left_out += omitted(
            context.graph, learns=bool({"psi", "evaluate", "report"} & phases)
        )
    with context.tracked():
        for name, task in tasks.items():
            with context.running(name):
                task.run(context)
    if context.last_words:
        print(context.last_words)
    if not {"evaluate", "report"} & phases:
        return None
    # Psi was learned on val, so this score is for choosing settings, never for reporting. It uses no test images.
    return context.results(context.graph.validation(context.results(context.graph.learned))).ap.mean


def warn_of_uncovered(graph: Graph) -> None:
    """Warn about bins without photographs nearby: a field may show debris from directions that no photograph shows."""
    distribution = graph.experiment.imaging.distribution
    for name, factors in graph.experiment.imaging.coverage.items():
        for factor, found in factors.items():
            if found.missing:
                out = bool(distribution.factor(factor).closed(name).any())
                _log.warning(
                    "%s: no photograph is within %.0f degrees of most poses in %d of the %d bins of parameter.%s: %s; "
                    "%s",
                    name, found.within_deg, len(found.missing), len(found.fractions), factor,
                    ", ".join(str(number) for number in found.missing),
                    "they are left out, parameter.pose.uncovered=render keeps them" if out
                    else "they are rendered, and may show debris",
                )  # fmt: skip


def warn_of_misreading(graph: Graph) -> None:
    """Warn where psi is estimated from photographs: of those whose bins are known, at most half were read right."""
    method, outer = graph.experiment.loop.method, graph.experiment.loop.outer
    alone = isinstance(method, LabelShift)
    first = isinstance(method, HypergradientLoop) and isinstance(outer.first_step, LabelShift)
    if graph.renders_target or not (alone or first):
        return
    _log.warning(
        "what your photographs show is estimated, and may be wrong: where the bins were known, a quarter to half of "
        "the boxes were read right (docs/results.md, On real frames); %s",
        f"no training judges the estimate with baseline={method.name}, baseline=neural_sim does" if alone
        else "a training judges the estimate; compare its scores with those before",
    )  # fmt: skip


def omitted(graph: Graph, learns: bool) -> list[Omission]:
    """Return the work that a run leaves out because it is not needed, and write it to the log file.

    Args:
        graph: stages of the run.
        learns: whether the run learns psi at all.
    """
    x, draws = graph.experiment, graph.learned.draws
    method, outer, distribution = x.loop.method, x.loop.outer, x.imaging.distribution
    loops, follows = not isinstance(method, (Fixed, LabelShift)), isinstance(method, HypergradientLoop)
    fixed = 0.0 if outer.learned is None else 1.0 - len(outer.learned) / len(graph.names)
    rows = [
        (not distribution.lights, "field", "appearance codes", "no parameter changes the light", None),
        (isinstance(method, Fixed), "psi", "the psi loop", f"baseline={method.name} keeps its distribution", 1.0),
        (isinstance(method, LabelShift), "warm_start", "the warm start", f"baseline={method.name} uses none", 1.0),
        (isinstance(method, LabelShift), "psi", "the psi loop", f"baseline={method.name} trains no detector", 1.0),
        (loops and not follows, "psi", "hypergradients", f"baseline={method.name} compares trainings only", 1.0),
        (follows and isinstance(draws, HardDraws), "psi", "the renderer's derivative",
         "the estimator scores images and does not differentiate them", 1.0),
        (follows and fixed > 0.0, "psi", "probes", "outer.learned fixes the other objects' psi", fixed),
        (loops and pooled(outer, draws, distribution), "psi", "most renders of the loop",
         "fields do not change: every bin is rendered once", None),
        (loops and outer.epochs > 1, "psi", "passes of the backbone's frozen stages in the loop's training",
         "their features are kept", 1.0 - 1.0 / outer.epochs),
    ]  # fmt: skip
    found = [
        Omission(phase, what, why, fraction)
        for applies, phase, what, why, fraction in rows
        if applies and (learns or phase != "psi")
    ]
    for each in found:
        _log.debug("left out: %s: %s", each.what, each.why)
    return found

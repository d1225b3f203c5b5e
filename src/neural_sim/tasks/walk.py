"""A run: the stages of ``stages=[...]``, one after another."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from neural_sim.stages.graph import Graph
from neural_sim.stages.plan import plan
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task
from neural_sim.tasks.report import write_report

_log = logging.getLogger(__name__)


def views(context: Context) -> None:
    """Make the views of all objects."""
    for stage in context.shown(context.graph.views, "views"):
        context.results(stage)


def fields(context: Context) -> None:
    """Make the fields of all objects."""
    for stage in context.shown(context.graph.fields, "field"):
        fitted = context.results(stage)
        if context.live:
            context.live.fields({stage.views.object: fitted.history})


def target_sets(context: Context) -> None:
    """Make the target sets."""
    context.results(context.graph.targets)


def warm_start(context: Context) -> None:
    """Train the warm start."""
    context.results(context.graph.warm_start)


def psi(context: Context) -> None:
    """Learn psi."""
    learned = context.results(context.graph.learned)
    if context.live:
        context.live.iterations([dataclasses.asdict(record) for record in learned.records])


def evaluate(context: Context) -> None:
    """Score the detectors that the report compares."""
    graph, results = context.graph, context.results
    learned = results(graph.learned)
    on_the_way = [
        graph.scores(at, f"psi after {i} iterations") for i, at in graph.on_the_way(learned).items()
    ]
    for scores in context.shown([*graph.compared(learned).values(), *on_the_way], "evaluate"):
        results(scores)
    # val steered psi too: a score to choose settings by, never one to report. Nothing of test is in it.
    context.returned = results(graph.scores(learned.last, "learned", "val")).ap.mean


_MADE: Mapping[str, Callable[[Graph], Iterable[Stage[Any]]]] = {
    "views": lambda graph: graph.views,
    "field": lambda graph: graph.fields,
    "target_sets": lambda graph: [graph.targets],
    "warm_start": lambda graph: [graph.warm_start],
    "psi": lambda graph: [graph.learned],
    "evaluate": lambda graph: [graph.learned, graph.scores(graph.psi("initial"), "ns")],
    "report": lambda graph: (),  # reads what depends on the learned psi
}
"""What steps make that is known before any runs."""

STEPS: Mapping[str, Callable[[Context], None]] = {
    "views": views,
    "field": fields,
    "target_sets": target_sets,
    "warm_start": warm_start,
    "psi": psi,
    "evaluate": evaluate,
    "report": write_report,
}
"""The stages of a run from objects to a report, in their order; a target of photographs comes first."""


def walk(context: Context, others: Mapping[str, Task]) -> float | None:
    """Run the context's stages: those of ``STEPS`` in its order, then ``others`` in theirs.

    Returns what a sweep may maximise: the AP on validation images of the detector trained on the learned distribution.
    None where nothing was evaluated.
    """
    asked = [name for name in STEPS if name in context.stages]
    if asked:
        context.account.left_out += plan(context.graph)
        if {"warm_start", "psi", "evaluate"} & {*asked}:
            context.graph.warm_start.build()  # so that weights which do not fit it are refused now
        if not context.graph.renders_target:
            # Photographs that cannot be used are refused before fields are fitted.
            asked.sort(key=lambda name: name != "target_sets")
        for name in asked:
            for stage in _MADE[name](context.graph):
                context.results.check(stage)
    for omission in context.account.left_out:
        fraction = "" if omission.fraction in (None, 1.0) else f" ({omission.fraction:.0%})"
        _log.info("left out: %s%s: %s", omission.what, fraction, omission.why)
    with context.tracked():
        for name in asked:
            with context.timed(name):
                STEPS[name](context)
        for name, step in others.items():
            with context.timed(name):
                step.run(context)
    return context.returned

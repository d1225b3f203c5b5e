"""Variants of an experiment for studies to compare: with other seeds, other methods or other target sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

from annotated_types import MinLen

from neural_sim.ranges import Distinct
from neural_sim.stages.graph import Graph
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.tasks.context import Context

Methods = Annotated[Sequence[str], MinLen(1), Distinct()]
"""Names of baselines."""


def graphs_of_methods(context: Context, methods: Sequence[str], key: str) -> dict[str, Graph]:
    """Compose the same command with each ``baseline=...``; all are built here, so that bad ones are refused at once.

    Raises:
        ValueError: a method is unknown, or the context cannot compose; the message names the setting ``key``.
    """
    if context.of_method is None:
        raise ValueError(f"{key}: this context composes no other method's configuration")
    return {method: Graph(context.of_method(method)) for method in methods}


def graphs_of_seeds(context: Context, seeds: int) -> list[Graph]:
    """Return the stages of the experiment for the run's seed and the following ones.

    Raises:
        ValueError: the task is not detection.
    """
    x = context.experiment
    x.check_boxes("a comparison of sources of images")
    return [Graph(replace(x, run=replace(x.run, seed=x.run.seed + i))) for i in range(seeds)]


def sets_of_kinds(graph: Graph, kinds: Mapping[str, Sequence[int]]) -> dict[str, TargetSetsStage]:
    """Return target sets with other numbers of objects per image, by the name of each kind."""
    synthesis = graph.experiment.imaging.synthesis
    return {
        kind: replace(graph.targets, synthesizer=replace(synthesis, objects_per_image=tuple(count)))
        for kind, count in kinds.items()
    }

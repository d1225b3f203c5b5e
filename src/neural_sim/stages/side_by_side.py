"""Detectors trained on images of several sources, each scored on several test sets, seed by seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from neural_sim.report.bootstrap import match
from neural_sim.report.side_by_side import SideBySide, side_by_side
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.evaluate import ScoresStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.tasks.context import Context
from neural_sim.tasks.walk import STEPS
from neural_sim.types import LabelledImages


def graphs_of_seeds(context: Context, seeds: int) -> list[Graph]:
    """The experiment's stages for the run's seed and those that follow it.

    Raises:
        ValueError: a task other than detection.
    """
    x = context.experiment
    x.check_boxes("a comparison of sources of images")
    return [Graph(replace(x, run=replace(x.run, seed=x.run.seed + i))) for i in range(seeds)]


def results_of_study(context: Context) -> Results:
    """The context's results, which also computes what a study compares and ``stages`` does not list."""
    return Results(Store(context.experiment.run.store), {*context.stages, *STEPS}, context.account.reused)


def sets_of_kinds(graph: Graph, kinds: Mapping[str, Sequence[int]]) -> dict[str, TargetSetsStage]:
    """The target sets with other numbers of objects an image, by the name of each kind."""
    synthesis = graph.experiment.imaging.synthesis
    return {
        kind: replace(graph.targets, synthesizer=replace(synthesis, objects_per_image=tuple(count)))
        for kind, count in kinds.items()
    }


def compare_sources(
    graphs: list[Graph],
    results: Results,
    sources: Callable[[Graph], Mapping[str, DetectorStage]],
    tests: Callable[[Graph], Mapping[str, TargetSetsStage]],
    draws: int,
) -> SideBySide:
    """AP of every source's detector on every test set; the first source is the one the others are compared with."""
    matches, images = {}, {}
    for graph in graphs:
        for kind, targets in tests(graph).items():
            test = results(targets).test
            images[kind] = images.get(kind, 0) + len(test)
            row = []
            for stage in sources(graph).values():
                found = results(ScoresStage(stage, targets)).detections
                row.append([match(found, test, label) for label in range(len(graph.names))])
            matches.setdefault(kind, []).append(row)
    seeds = [graph.experiment.run.seed for graph in graphs]
    return side_by_side(matches, list(sources(graphs[0])), list(graphs[0].names), seeds, images, draws)


def pairs(graph: Graph, results: Results, sources: Mapping[str, DetectorStage], count: int) -> LabelledImages:
    """``count`` training images of every source, source by source, spread evenly over those of the first; where
    the sources share their draws, the same ones.
    """
    parts = []
    for stage in sources.values():
        images = stage.images(results).images.to("cpu")
        rows = torch.linspace(0, len(images) - 1, min(count, len(images))).round().long()
        parts.append(images.select(rows))
    return LabelledImages.concatenate(parts)

"""Work that a run leaves out because its scene does not need it, logged before it begins, with reason and fraction."""

from __future__ import annotations

import math
from collections.abc import Iterator

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.field.grid import GridField
from neural_sim.outer.inner import pooled
from neural_sim.stages.account import Omission
from neural_sim.stages.experiment import Experiment
from neural_sim.stages.graph import Graph
from neural_sim.synthesis.draws import HardDraws
from neural_sim.synthesis.pool import pool_cells


def plan(graph: Graph) -> list[Omission]:
    """Everything that this configuration leaves out, stage by stage."""
    return [*_fields(graph.experiment), *_loop(graph)]


def _fields(x: Experiment) -> Iterator[Omission]:
    field = x.imaging.field.field()
    if isinstance(field, GridField):
        yield Omission(
            "field", "coarse and fine passes", "the grid samples only cells that the views leave occupied"
        )
        yield Omission("field", "rays far from silhouettes", "they see no object in any view that trains")
        if field.head is None:
            yield Omission(
                "field",
                "view-dependent colour",
                "one fixed light on matt surfaces looks the same from all sides",
            )
    if not x.imaging.distribution.lights:
        yield Omission("field", "appearance codes", "no parameter moves the light")


def _loop(graph: Graph) -> Iterator[Omission]:
    x, objects = graph.experiment, len(graph.names)
    method, outer = x.loop.method, x.loop.outer
    if isinstance(method, Fixed):
        yield Omission("psi", "the psi loop", f"baseline={method.name} keeps its distribution", 1.0)
        return
    follows = isinstance(method, HypergradientLoop)
    if follows:
        yield from _hypergradient(x, objects)
    else:
        yield Omission("psi", "hypergradients", f"baseline={method.name} compares trainings only", 1.0)
    if pooled(outer, graph.learned.draws, x.imaging.distribution):
        yield from _pooled(x, getattr(method, "rounds", 1) * outer.iterations, follows)
    if outer.quality not in (None, x.imaging.renderer.quality):
        yield Omission(
            "psi", "fine renders in the loop", f"outer.quality={outer.quality}; the scored images are fine"
        )
    if outer.epochs > 1:
        what, why = "passes of the backbone's frozen stages in the loop's training", "their features are kept"
        yield Omission("psi", what, why, 1.0 - 1.0 / outer.epochs)


def _hypergradient(x: Experiment, objects: int) -> Iterator[Omission]:
    estimator, outer = x.loop.gradient, x.loop.outer
    name = type(estimator).__name__.removesuffix("Estimator").lower()
    if isinstance(estimator.draws, HardDraws):
        why = f"gradient={name} scores images and differentiates none"
        yield Omission("psi", "the renderer's derivative", why, 1.0)
    else:
        yield Omission("psi", "the boxes' derivative", "boxes are fixed labels, as in the paper", 1.0)
    if outer.learned is not None and len(outer.learned) < objects:
        fraction = 1.0 - len(outer.learned) / objects
        yield Omission(
            "psi", "probes and second derivatives", "outer.learned fixes the other objects' psi", fraction
        )
    images = objects * outer.images_per_object
    if outer.adjoint == "implicit" and 0 < outer.curvature_images < images:
        fraction = 1.0 - outer.curvature_images / images
        yield Omission("psi", "images in Hessian products", "outer.curvature_images stand for all", fraction)


def _pooled(x: Experiment, rounds: int, follows: bool) -> Iterator[Omission]:
    """The fraction of the loop's renders that a pool of every bin saves, if any. An image of several objects needs a
    render of each. Trainings that judge a step are not counted, since not every iteration has one.
    """
    factors, outer = x.imaging.distribution.binned, x.loop.outer
    rendered = math.prod(pool_cells(factors, outer.pool_per_bin))
    trainings, probes = rounds, 0.0
    if follows:
        derivatives = rounds
        if outer.steps == "checked":  # several derivatives in the first iteration, none in the last
            trainings += outer.checks.trainings - 1
            derivatives = trainings - 1
        anew = 1.0 + (derivatives - 1) * outer.refresh
        probes = anew * x.loop.gradient.probes_per_bin * sum(factor.bins for factor in factors)
    shown = sum(x.imaging.synthesis.objects_per_image) / 2.0
    wanted = shown * (trainings * outer.images_per_object + probes)
    if rendered < wanted:
        why = "fields do not change: every bin is rendered once"
        yield Omission("psi", "renders of the loop", why, 1.0 - rendered / wanted)

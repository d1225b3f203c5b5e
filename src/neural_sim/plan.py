"""What a run will not do because its scene does not need it, said before it begins, with the reason and the share."""

from __future__ import annotations

import math
from collections.abc import Iterator

from neural_sim.baseline.base import Fixed, HypergradientLoop, RewardMethod
from neural_sim.experiment import Experiment, Omission
from neural_sim.field.grid import GridField
from neural_sim.outer.inner import pooled
from neural_sim.synthesis.pool import pool_cells
from neural_sim.synthesis.scene import HardDraws


def plan(experiment: Experiment, objects: int) -> list[Omission]:
    """Everything that this configuration leaves out, stage by stage."""
    return [*_fields(experiment), *_loop(experiment, objects)]


def _fields(x: Experiment) -> Iterator[Omission]:
    field = x.field.field()
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
    if x.distribution.light is None:
        yield Omission("field", "appearance codes", "no parameter moves the light")


def _loop(x: Experiment, objects: int) -> Iterator[Omission]:
    method, outer = x.baseline, x.outer
    if isinstance(method, Fixed):
        yield Omission("psi", "the psi loop", f"baseline={method.name} keeps its distribution", 1.0)
        return
    searched = not isinstance(method, HypergradientLoop)
    if searched:
        yield Omission("psi", "hypergradients", f"baseline={method.name} sees rewards only", 1.0)
    else:
        yield from _hypergradient(x, objects)
    if pooled(outer, x.draws, x.distribution):
        yield _pooled(x, method, searched)
    if outer.quality not in (None, x.renderer.quality):
        yield Omission(
            "psi", "fine renders in the loop", f"outer.quality={outer.quality}; the scored images are fine"
        )
    if outer.epochs > 1:
        what, why = "backbone passes of the loop's training", "a frozen backbone's features are kept"
        yield Omission("psi", what, why, 1.0 - 1.0 / outer.epochs)


def _hypergradient(x: Experiment, objects: int) -> Iterator[Omission]:
    estimator = x.gradient
    name = type(estimator).__name__.removesuffix("Estimator").lower()
    if isinstance(estimator.draws, HardDraws):
        why = f"gradient={name} scores images and differentiates none"
        yield Omission("psi", "the renderer's derivative", why, 1.0)
    elif x.synthesis.label_gradient == "ignored":
        yield Omission(
            "psi", "the boxes' derivative", "synthesis.label_gradient=ignored, as in the paper", 1.0
        )
    if x.outer.learned is not None and len(x.outer.learned) < objects:
        share = 1.0 - len(x.outer.learned) / objects
        yield Omission(
            "psi", "probes and second derivatives", "outer.learned fixes the other objects' psi", share
        )
    images = objects * x.outer.images_per_object
    if 0 < x.outer.curvature_images < images:
        share = 1.0 - x.outer.curvature_images / images
        yield Omission("psi", "images in Hessian products", "outer.curvature_images stand for all", share)


def _pooled(x: Experiment, method: HypergradientLoop | RewardMethod, searched: bool) -> Omission:
    """Renders that a pool of every bin spares, of all that the loop's images would take."""
    factors = x.distribution.binned
    rendered = math.prod(pool_cells(factors, x.outer.pool_per_bin))
    rounds = getattr(method, "rounds", 1) * x.outer.iterations
    probes = 0.0
    if not searched:
        anew = 1.0 + (rounds - 1) * x.outer.refresh
        probes = anew * x.gradient.probes_per_bin * sum(factor.bins for factor in factors)
    wanted = rounds * x.outer.images_per_object + probes
    share = max(0.0, 1.0 - rendered / wanted)
    return Omission("psi", "renders of the loop", "fields do not change: every bin is rendered once", share)

"""Finer fields for larger images: views at the resolution of the images, and grids to match."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from neural_sim.cameras import focal_length
from neural_sim.field.recipe import FieldRecipe
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.views import Views
from neural_sim.stages.field import FieldStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results
from neural_sim.types import PinholeCamera

_log = logging.getLogger(__name__)

ENOUGH = 1.25
"""The run's own fields are used for images with up to this many times the resolution of the fields' views."""


def view_size_for(
    views: Views, camera: PinholeCamera, distribution: SceneDistribution, largest_radius: float
) -> int:
    """Return the image size, in pixels, at which the closest views resolve as much detail as ``camera``.

    The camera is taken at its smallest distance and longest focal length. ``largest_radius`` is the radius of the
    largest object, in the unit of the distribution's distances.
    """
    drawn = {factor.coordinate: factor for factor in distribution.binned}
    nearest = drawn["distance"].low if "distance" in drawn else distribution.ranges["distance"][0]
    longest = drawn["magnification"].high if "magnification" in drawn else 1.0
    wanted = focal_length(camera) * longest * largest_radius / nearest  # pixels per radius
    seen = focal_length(views.camera(1)) / views.distance_range[0]  # the same for views of one pixel
    return math.ceil(wanted / seen)


def finer_recipe(recipe: FieldRecipe, factor: float) -> FieldRecipe:
    """Return the recipe for views with ``factor`` times as many pixels along each side.

    Steps are multiplied by the factor, and the cells of a grid along each side by the power of two nearest to it. The
    number of refinements does not change.
    """
    fitting: Callable[..., Any] = recipe.fitting
    steps = math.ceil(recipe.steps * factor)
    if isinstance(fitting, functools.partial) and "resolution" in fitting.keywords:
        given = dict(fitting.keywords)
        scaled = {
            key: tuple(math.ceil(step * factor) for step in given[key])
            for key in ("refine_steps", "prune_steps")
            if key in given
        }
        cells = given["resolution"] * 2 ** round(math.log2(factor))  # the visual hull needs a power of two
        fitting = functools.partial(fitting.func, *fitting.args, **{**given, **scaled, "resolution": cells})
    return replace(recipe, fitting=fitting, steps=steps)


def finer_fields(graph: Graph, camera: PinholeCamera, largest: int) -> tuple[FieldStage, ...]:
    """Return the run's fields, or finer ones if images of ``camera`` would show the pixels of the run's views.

    Finer views have at most ``largest`` pixels a side. The log states the resolution that is needed and used.
    """
    views, recipe = graph.experiment.imaging.views, graph.experiment.imaging.field
    if not graph.objects.has_meshes:
        _log.info(
            "export: finer fields need meshes of all objects; the run's, fitted to views of %d pixels, are used",
            views.image_size,
        )
        return graph.fields
    radius = max(graph.radii) if graph.radii is not None else 1.0
    wanted = view_size_for(views, camera, graph.experiment.imaging.distribution, radius)
    size = (
        max(views.image_size, min(wanted, largest))
        if wanted > ENOUGH * views.image_size
        else views.image_size
    )
    _log.info(
        "export: images of %d x %d resolve as much as views of %d pixels a side; fields are fitted to views of %d%s",
        camera.width, camera.height, wanted, size,
        f" (export.largest_views; each view pixel covers {wanted / size:.1f} image pixels)" if size < wanted else "",
    )  # fmt: skip
    if size == views.image_size:
        return graph.fields
    finer = replace(views, image_size=size)
    made = finer_recipe(recipe, size / views.image_size)
    return tuple(
        replace(stage, recipe=made, views=replace(stage.views, settings=finer)) for stage in graph.fields
    )


def cost_of(finer: Sequence[FieldStage], own: Sequence[FieldStage], results: Results) -> str:
    """Return a sentence on what finer fields cost, for the log before they are fitted.

    Args:
        finer: the fields that an export wants.
        own: the run's own fields.
        results: tells which fields the store lacks.

    Returns:
        The sentence; empty if the store has all finer fields, or if they are the run's own.
    """
    missing = 0 if list(finer) == list(own) else sum(stage in finer for stage in results.missing(finer))
    if not missing:
        return ""
    steps = finer[0].recipe.steps / own[0].recipe.steps
    pixels = (finer[0].views.settings.image_size / own[0].views.settings.image_size) ** 2
    return (
        f"{missing} finer field{'s' if missing > 1 else ''} to fit first, each with {steps:.1f} times the steps and "
        f"{pixels:.0f} times the pixels of a field of the run; export.detail=run uses the run's fields instead"
    )

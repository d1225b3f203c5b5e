"""How long a run will take, judging by the last run like it, or by measured costs and the speed of this machine."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

import torch
from torch.nn.functional import conv2d, group_norm, silu

from neural_sim.baseline.base import Fixed, HypergradientLoop
from neural_sim.baseline.label_shift.settings import LabelShift
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.documents import parsed_json
from neural_sim.field.grid import GridField
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.objects.photos import Photos
from neural_sim.outer.progress import duration
from neural_sim.stages.cameras import CommandMasksStage, MasksStage
from neural_sim.stages.detector import DetectorStage, TrainedStage
from neural_sim.stages.field import FieldStage
from neural_sim.stages.psi import PsiStage
from neural_sim.stages.shown import ShownStage
from neural_sim.stages.stage import Stage
from neural_sim.stages.symmetry import SymmetryStage
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.stages.views import ViewsStage
from neural_sim.target.rendered import RenderedTarget
from neural_sim.tasks.context import Context

MEASURED: dict[str, tuple[float, float]] = {
    "views": (0.8, 0.85),
    "photographs": (0.5, 0.38),
    "masks": (0.0, 22.5),
    "field": (1.4, 13.8),
    "target_sets": (0.5, 1.5),
    "detector": (1.5, 0.5),
    "symmetry": (0.9, 0.0),
    "pool": (0.5, 1.7),
    "reading": (4.0, 0.9),
    "training": (0.7, 0.8),
    "derivative": (8.0, 0.6),
    "report": (12.0, 0.0),
}
"""CPU seconds of one thread for each kind of work, and for each million of its pixels or rays.

From +experiment=pose_gap at scale=smoke (commit 0e8c613) and scale=quick (commit bf70253); photographs and masks from
49 and 80 photographs of 1,000 pixels and 160 of 160 (commit 0642912).
"""
OPENED = 1e5
"""Opening a photograph takes as long as resampling this many of its pixels."""
LAYERS = 0.1
"""CPU seconds of one thread for ``_layers``, on the same machine."""
QUICK = ("sample", "viewer", "box")
"""Tasks that take no time of their own: they write or show what stages made."""
SPREAD = (0.8, 1.4)
"""What a run may take, as fractions of what is expected."""
MILLION = 1e6


def forecast(context: Context, missing: Sequence[Stage[Any]]) -> str:
    """Return a phrase on how long it will take to make the missing results; empty if nothing is known.

    The last run with this name, scale and method is the best guide. A result that it found in the store counts with
    the time that it took to compute. Without such a run, the time is estimated from measured costs.
    """
    if not context.scale or not missing:
        return ""
    return _as_before(context, {stage.phase for stage in missing}) or _by_costs(context, missing)


def _as_before(context: Context, phases: Iterable[str]) -> str:
    files = sorted(context.folder.parent.glob("*/results.json"), key=lambda path: -path.stat().st_mtime)
    alike = {"scale": context.scale, "method": context.experiment.loop.method.name}
    for path in files:
        try:
            held = parsed_json(path.read_text(encoding="utf-8"))
            if any(held.get(key) != value for key, value in alike.items()):
                continue
            spent = {phase: held["seconds"].get(phase, 0.0) for phase in phases}
            for found in held["left_out"]:
                if found["stage"] in spent:
                    spent[found["stage"]] += found["seconds"] or 0.0
        except (OSError, ValueError, KeyError, TypeError, AttributeError):  # a file of an older version
            continue
        if all(spent.values()):
            return f": about {duration(sum(spent.values()))}, as on {held['date']}"
    return ""


def _by_costs(context: Context, missing: Sequence[Stage[Any]]) -> str:
    if context.graph.device.type != "cpu" or context.experiment.run.workers != 1:
        return ""
    spent: dict[str, float] = {}
    unknown: dict[str, None] = {}
    for stage in _with_scored(context, missing):
        if (seconds := _seconds(stage)) is None:
            unknown[stage.phase] = None
        else:
            spent[stage.phase] = spent.get(stage.phase, 0.0) + seconds
    made = {name: (context.config.get(name) or {}).get("_target_", "") for name in context.stages}
    tasks = [name for name, target in made.items() if target.startswith("neural_sim.tasks.")]
    unknown |= dict.fromkeys(name for name in tasks if name not in QUICK)
    if "report" in context.stages:
        spent["report"] = spent.get("report", 0.0) + MEASURED["report"][0]
    spent = {phase: seconds for phase, seconds in spent.items() if seconds and phase not in unknown}
    if not spent:
        return ""
    slower = _layers() / LAYERS
    total = slower * sum(spent.values())
    parts = ", ".join(f"{phase} {duration(slower * seconds)}" for phase, seconds in spent.items())
    said = f": about {duration(SPREAD[0] * total)} to {duration(SPREAD[1] * total)} ({parts})"
    if more := sum(_more(stage) for stage in missing):
        said += f", and up to {duration(slower * more)} more if psi takes all iterations"
    return said + (f"; not counting {', '.join(unknown)}, unknown before a first run" if unknown else "")


def _with_scored(context: Context, missing: Sequence[Stage[Any]]) -> list[Stage[Any]]:
    """Add the detectors scored at the end that tasks do not list: the target's, and that of the psi not yet learned."""
    graph, found = context.graph, list(missing)
    known = {stage.entry for stage in missing}
    if {"evaluate", "report"} & set(context.stages):
        if graph.target_psi is not None:
            matched = context.results.missing([graph.scores(graph.target_psi, "matched")])
            found += [stage for stage in matched if stage.entry not in known]
        if graph.learned.entry in known and not isinstance(graph.learned.method, Fixed):
            found.append(graph.trained_on(graph.psi("initial"), "learned"))
    return found


def _seconds(stage: Stage[Any]) -> float | None:
    """Return the seconds that a result takes on the machine of ``MEASURED``; None: not known."""
    parts = _work(stage)
    if parts is None:
        return None
    return sum(MEASURED[kind][0] + MEASURED[kind][1] * units / MILLION for kind, units in parts)


def _work(stage: Stage[Any]) -> list[tuple[str, float]] | None:
    """Return the kinds of work of a stage with their amounts; empty: next to nothing; None: not known."""
    if isinstance(stage, ViewsStage):
        views = stage.settings
        if not stage.objects.part(stage.object).has_meshes:
            return _of_photographs(stage)
        return [("views", (views.count + views.held_out) * views.image_size**2)]
    if isinstance(stage, MasksStage):
        return _of_masks(stage)
    if isinstance(stage, FieldStage):
        rays = getattr(stage.recipe.fitting, "keywords", {}).get("batch_rays", 0)
        known = stage.recipe.kind is GridField and stage.views.settings.lights is None and rays > 0
        return [("field", stage.recipe.steps * rays)] if known else None
    if isinstance(stage, TargetSetsStage):
        return _of_target(stage)
    if isinstance(stage, DetectorStage):
        images = stage.training.images_per_object * len(stage.names)
        return [("detector", images * stage.epochs * _pixels(stage))] if _tiny(stage) else None
    if isinstance(stage, SymmetryStage):
        return [("symmetry", 0.0)]
    if isinstance(stage, PsiStage):
        return _of_psi(stage)
    return None if isinstance(stage, (TrainedStage, ShownStage, CommandMasksStage)) else []


def _of_photographs(stage: ViewsStage) -> list[tuple[str, float]] | None:
    source, views = stage.objects.part(stage.object).source, stage.settings
    if not isinstance(source, Photos) or getattr(stage.refinement, "rounds", 0) > 0:
        return None
    parts = source.split(stage.object, views.count, views.held_out)
    lenses = [frame.lens for part in parts for frame in part]
    return [("photographs", sum(lens.width * lens.height + OPENED for lens in lenses))]


def _of_masks(stage: MasksStage) -> list[tuple[str, float]] | None:
    """Return the rays of the scene's fit, and those of the masks that it renders."""
    from neural_sim.field.scene.recipe import SceneMasks  # only runs on photographs load it

    scene = stage.scene
    if not isinstance(scene, SceneMasks):
        return None
    sides = [(frame.lens.width, frame.lens.height) for frame in stage.source.captures[stage.object].frames]
    rendered = sum(scene.image_size**2 * min(side) / max(side) for side in sides)
    return [("masks", scene.steps * scene.batch_rays + rendered)]


def _of_target(stage: TargetSetsStage) -> list[tuple[str, float]] | None:
    if not isinstance(stage.target, RenderedTarget) or stage.fields:
        return [] if stage.early else None
    biased = sum(name in stage.distribution.biased for name in stage.objects.names)
    target, others = stage.target, len(stage.objects.names) - biased
    each = target.val_per_object + target.train_per_object
    images = (
        (biased + others) * each + others * target.test_per_object + biased * target.test_per_biased_object
    )
    return [("target_sets", images * stage.camera.width * stage.camera.height)]


def _of_psi(stage: PsiStage) -> list[tuple[str, float]] | None:
    """Return the work that a loop is sure to do; with ``outer.patience`` it may end after its first iteration."""
    if isinstance(stage.method, Fixed):
        return []
    if not _known_loop(stage):
        return None
    outer, warm = stage.outer, stage.warm_start
    bins = sum(factor.bins for factor in stage.distribution.binned)
    rendered = stage.pool.per_bin * bins * len(warm.names) * _pixels(warm)
    iterations = 1 if outer.patience is not None else outer.iterations
    reads = [("reading", rendered)] if isinstance(outer.first_step, LabelShift) else []
    return [("pool", rendered), *reads, *(iterations - 1) * _iteration(stage), ("training", _trained(stage))]


def _more(stage: Stage[Any]) -> float:
    """Return the seconds of the iterations that a loop may do without."""
    if not isinstance(stage, PsiStage) or stage.outer.patience is None or not _known_loop(stage):
        return 0.0
    once = sum(MEASURED[kind][0] + MEASURED[kind][1] * units / MILLION for kind, units in _iteration(stage))
    return (stage.outer.iterations - 1) * once


def _known_loop(stage: PsiStage) -> bool:
    parts, outer = stage.parts, stage.outer
    return (
        isinstance(stage.method, HypergradientLoop)
        and parts is not None
        and isinstance(parts.estimator, StratifiedEstimator)
        and isinstance(outer.adjoint, Unrolled)
        and outer.pool_per_bin > 0
        and not stage.distribution.lights
        and _tiny(stage.warm_start)
    )


def _iteration(stage: PsiStage) -> list[tuple[str, float]]:
    return [("training", _trained(stage)), ("derivative", _trained(stage))]


def _trained(stage: PsiStage) -> float:
    images = stage.outer.images_per_object * len(stage.warm_start.names)
    steps = -(-images // stage.warm_start.training.batch_size)
    epochs = max(stage.outer.epochs, -(-stage.outer.least_steps // steps))
    return images * epochs * _pixels(stage.warm_start)


def _tiny(stage: DetectorStage) -> bool:
    """Return whether a detector is the one that was measured."""
    given = getattr(stage.detector, "keywords", {})
    architecture = getattr(given.get("backbone"), "architecture", None)
    return getattr(stage.detector, "func", None) is RetinaNet and architecture == "tiny"


def _pixels(stage: DetectorStage) -> int:
    return stage.camera.width * stage.camera.height


def _layers() -> float:
    """Time a few layers of a detector's size, forwards and backwards."""
    weights = torch.full((48, 48, 3, 3), 1e-3, requires_grad=True)
    images = torch.full((32, 48, 24, 24), 0.5)
    spent = []
    for _ in range(3):
        begun, values = time.perf_counter(), images
        for _ in range(3):
            values = silu(group_norm(conv2d(values, weights, padding=1), 6))
        values.sum().backward()
        spent.append(time.perf_counter() - begun)
    return median(spent)

"""Memory and time of the renderer's derivative, patch by patch and in forward mode (the paper's Sec. A.1, Tool 3)."""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from annotated_types import MinLen
from torch import Tensor
from typing_extensions import override

from neural_sim.devices import peak_bytes, synchronise
from neural_sim.documents import markdown_table
from neural_sim.gradient.mixed import image_cotangents
from neural_sim.gradient.pathwise import PathwiseEstimator, contract, draw_cotangents, map_cotangents
from neural_sim.outer.derivative import image_losses, rendered_path
from neural_sim.parameter.product import HARD
from neural_sim.ranges import PositiveInt, validated
from neural_sim.report.tracking import Run
from neural_sim.stages.stage import Stage
from neural_sim.studies.frozen_loop import FrozenLoop, pathwise_of, relative_error
from neural_sim.synthesis.assembly import RenderedObject, one_each
from neural_sim.tasks.context import Context, Task
from neural_sim.types import Maps

FORWARD, WHOLE = "forward", "reverse, whole image"


@dataclass(frozen=True)
class PatchCost:
    """Cost of one way to differentiate an image of an object with respect to the scene parameters that psi moves.

    Attributes:
        object: the object's name.
        method: forward or reverse mode, and the patch.
        patch: rays per patch; None in forward mode.
        gradient_mb: peak memory of the renderer's derivative in MiB. In forward mode, that of the render that computes
            it, without the maps and their derivatives.
        total_mb: peak memory in MiB of the whole estimate from one image of every object: rendering, the loss's
            derivative with respect to the images, the renderer's derivative.
        milliseconds: wall-clock time of the render and the renderer's derivative.
        cpu_milliseconds: CPU time of all cores for the same.
        difference: |derivative - that of forward mode| / |that of forward mode|.
    """

    object: str
    method: str
    patch: int | None
    gradient_mb: float
    total_mb: float
    milliseconds: float
    cpu_milliseconds: float
    difference: float


@validated
@dataclass(frozen=True)
class PatchMemory(Task):
    """``+experiment=patch_memory``: measure memory and time of the renderer's derivative, by mode and patch size.

    Args:
        patches: patch sizes in rays, for reverse mode. Those of at least a whole image are left out, because the whole
            image is always measured.
        repeats: number of timings; their median is reported.
    """

    patches: Annotated[tuple[PositiveInt, ...], MinLen(1)] = (64, 128, 256, 512)
    repeats: PositiveInt = 3

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        pathwise_of(context, "patch_memory")
        return [context.graph.warm_start, context.graph.targets]

    @override
    def run(self, context: Context) -> None:
        x = context.experiment
        estimator = pathwise_of(context, "patch_memory")
        rows = self.measure(FrozenLoop.of(context, x.run.seed), estimator, x.run.seed)
        camera, field = context.graph.camera, type(context.results(context.graph.fields[0]).field).__name__
        rays = x.imaging.renderer.rays_per_chunk
        setting = f"{field}, {camera.width} x {camera.height} pixels, {rays} rays per chunk"
        publish(context, rows, setting)

    def measure(self, loop: FrozenLoop, estimator: PathwiseEstimator, seed: int) -> list[PatchCost]:
        """Measure forward mode, and reverse mode with every patch size and on the whole image, for every object."""
        pixels = loop.scene.camera.width * loop.scene.camera.height
        sizes = [*(size for size in self.patches if size < pixels), pixels]
        ahead = replace(estimator, mode="forward")
        reverse = [(patch, replace(estimator, mode="reverse", patch_size=patch)) for patch in sizes]
        totals = {e: self._total(loop, e, seed) for e in (ahead, *(other for _, other in reverse))}
        rows = []
        for label, name in enumerate(loop.scene.names):
            one = _Image.of(loop, label, estimator, seed)
            truth = one.forward()
            megabytes = one.peak(lambda one=one: one.render(tangents=True)) - one.output_mb()
            spent = self._timed(one.forward, one.device)
            rows.append(PatchCost(name, FORWARD, None, megabytes, totals[ahead], *spent, 0.0))
            for patch, other in reverse:
                run = functools.partial(one.reverse, patch)
                spent = self._timed(lambda one=one, run=run: (one.render(tangents=False), run()), one.device)
                method = WHOLE if patch == pixels else f"reverse, patches of {patch}"
                megabytes, off = one.peak(run), _apart(run(), truth)
                rows.append(PatchCost(name, method, patch, megabytes, totals[other], *spent, off))
        return rows

    def _total(self, loop: FrozenLoop, estimator: PathwiseEstimator, seed: int) -> float:
        """Return the peak memory in MiB of one estimate from one image of every object."""
        device = loop.scene.device
        return peak_bytes(lambda: loop.pathwise(estimator, 1, _generator(seed)), device) / 2**20

    def _timed(self, run: Callable[[], object], device: torch.device) -> tuple[float, float]:
        """Return median milliseconds of wall-clock time and of CPU time."""
        wall, worked = [], []
        for _ in range(self.repeats):
            begun, cpu_begun = time.perf_counter(), time.process_time()
            run()
            synchronise(device)
            wall.append(time.perf_counter() - begun)
            worked.append(time.process_time() - cpu_begun)
        return 1e3 * statistics.median(wall), 1e3 * statistics.median(worked)


@dataclass(frozen=True)
class _Image:
    """One image of one object, and the cotangent of its maps; every render repeats the same draw."""

    loop: FrozenLoop
    label: int
    seed: int
    part: RenderedObject
    cotangents: Maps

    @staticmethod
    def of(loop: FrozenLoop, label: int, estimator: PathwiseEstimator, seed: int) -> _Image:
        scene, generator = loop.scene, _generator(seed)
        part = scene.draw(label, loop.psi[label], 1, generator, replace(estimator, mode="forward").draws)
        nuisance = scene.synthesizer.draw_nuisance(1, scene.camera, generator, scene.device)
        rendered = one_each([part], [nuisance], [label], scene.synthesizer)
        images, first = rendered.images, torch.zeros(1, dtype=torch.long)
        targets = loop.detector.assign(images.boxes, images.labels)
        losses = image_losses(loop.detector, loop.backbone, targets)
        pulled = image_cotangents(losses, loop.trainable, loop.vector, images.images, first, torch.ones(1))
        path = rendered_path(scene, label, part, rendered.compose[0])
        return _Image(loop, label, seed, replace(part, tangents=None), map_cotangents(path, pulled))

    @property
    def device(self) -> torch.device:
        return self.cotangents.rgb.device

    def peak(self, run: Callable[[], object]) -> float:
        return peak_bytes(run, self.device) / 2**20

    def render(self, tangents: bool) -> RenderedObject:
        relaxed = self.part.relaxed
        how = replace(relaxed, tangents=tangents) if relaxed is not None else HARD
        return self.loop.scene.draw(self.label, self.loop.psi[self.label], 1, _generator(self.seed), how)

    def forward(self) -> dict[str, Tensor]:
        return contract(self.render(tangents=True).tangents or {}, self.cotangents)

    def reverse(self, patch: int) -> dict[str, Tensor]:
        scene = self.loop.scene
        field, draw = scene.fields[self.label], self.part.draw
        return draw_cotangents(field.render_rays, scene.camera, draw, self.cotangents, patch)

    def output_mb(self) -> float:
        """Return MiB of the maps and of each derivative of them, which is as large as they are."""
        maps = (self.cotangents.rgb, self.cotangents.opacity)
        each = sum(values.numel() * values.element_size() for values in maps)
        return each * (1 + len(self.forward())) / 2**20


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _apart(values: Mapping[str, Tensor], truth: Mapping[str, Tensor]) -> float:
    return float(relative_error(*(torch.cat([each[name] for name in truth]) for each in (values, truth))))


def publish(context: Context, rows: Sequence[PatchCost], setting: str) -> Run | None:
    """Write patch_memory.json and patch_memory.md, and log every cost to MLflow; ``setting`` is the table's heading."""
    document = {"setting": setting, "rows": [dataclasses.asdict(row) for row in rows]}
    metrics = {
        f"{row.object}/{'forward' if row.patch is None else row.patch}/{key}": getattr(row, key)
        for row in rows
        for key in ("gradient_mb", "total_mb", "milliseconds", "cpu_milliseconds")
    }
    tags = {"method": "pathwise"}
    return context.publish("patch_memory", document, table(rows, setting), metrics=metrics, tags=tags)


def table(rows: Sequence[PatchCost], setting: str) -> str:
    """Return Markdown with one table per object."""
    parts = [
        f"Derivative of one image with respect to the scene parameters that depend on psi ({setting}). *Gradient* is "
        "the working memory of the renderer's derivative; *total* is the peak memory of the whole estimate, including "
        "the detector's derivatives, from one image of every object."
    ]
    head = ["method", "gradient, MiB", "total, MiB", "ms", "CPU ms", "relative difference from forward"]
    for name in dict.fromkeys(row.object for row in rows):
        cells = [
            (
                row.method,
                f"{row.gradient_mb:.2f}",
                f"{row.total_mb:.1f}",
                f"{row.milliseconds:.0f}",
                f"{row.cpu_milliseconds:.0f}",
                f"{row.difference:.0e}",
            )
            for row in rows
            if row.object == name
        ]
        parts += [f"**{name}**", markdown_table(head, cells)]
    return "\n\n".join(parts)

"""Memory and time of the renderer's derivative, patch by patch and in forward mode (the paper's Sec. A.1, Tool 3)."""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neural_sim.devices import synchronise
from neural_sim.gradient.mixed import input_cotangents
from neural_sim.gradient.pathwise import PathwiseEstimator, contract, draw_cotangents, map_cotangents
from neural_sim.outer.binding import image_losses, rendered_path
from neural_sim.outer.frozen import FrozenLoop
from neural_sim.outer.peak_memory import peak_bytes
from neural_sim.synthesis.assembly import RenderedObject, one_each
from neural_sim.synthesis.draws import HARD
from neural_sim.types import Maps

FORWARD, WHOLE = "forward", "reverse, whole image"


@dataclass(frozen=True)
class PatchCost:
    """One way to differentiate one image of an object by the numbers of its draw that depend on psi.

    ``patch`` is in rays, None in forward mode. ``gradient_mb`` is the most memory of the renderer's derivative, in
    forward mode of the render that computes it, without the maps and their derivatives. ``total_mb`` is that of the
    whole estimate from one image of every object: rendering, the loss's derivative by the images, the renderer's. Both
    in MiB. ``milliseconds`` and ``cpu_milliseconds`` (of all cores) are of rendering and the renderer's derivative.
    ``difference`` is the result's from that of forward mode, relative to its norm.
    """

    object: str
    method: str
    patch: int | None
    gradient_mb: float
    total_mb: float
    milliseconds: float
    cpu_milliseconds: float
    difference: float


@dataclass(frozen=True)
class PatchMemory:
    """``+experiment=patch_memory``.

    Args:
        patches: rays per patch of the reverse mode.
        repeats: timings, whose median counts.

    Raises:
        ValueError: no patch, one of less than a ray, or fewer than one repeat.
    """

    patches: tuple[int, ...] = (64, 128, 256, 512)
    repeats: int = 3

    def __post_init__(self) -> None:
        if not self.patches or min(self.patches) < 1:
            raise ValueError(f"patch_memory.patches: want numbers of rays from 1, got {list(self.patches)}")
        if self.repeats < 1:
            raise ValueError(f"patch_memory.repeats must be at least 1, got {self.repeats}")

    def measure(self, loop: FrozenLoop, estimator: PathwiseEstimator, seed: int) -> list[PatchCost]:
        """Every object: forward mode, the reverse mode by each patch size, and by the whole image at once."""
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
        """MiB of one estimate from one image of every object."""
        device = loop.scene.device(0)
        return peak_bytes(lambda: loop.pathwise(estimator, 1, _generator(seed)), device) / 2**20

    def _timed(self, run: Callable[[], object], device: torch.device) -> tuple[float, float]:
        """Median milliseconds, by the clock on the wall and of all cores."""
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
    """One image of one object with the loss's cotangent of its maps. ``names`` are the numbers of the draw that depend
    on psi; each rendering repeats the draw from the seed.
    """

    loop: FrozenLoop
    label: int
    seed: int
    part: RenderedObject
    cotangents: Maps

    @staticmethod
    def of(loop: FrozenLoop, label: int, estimator: PathwiseEstimator, seed: int) -> _Image:
        scene, generator = loop.scene, _generator(seed)
        part = scene.drawn(label, loop.psi[label], 1, generator, replace(estimator, mode="forward").draws)
        nuisance = scene.synthesizer.draw_nuisance(1, scene.camera, generator, scene.device(label))
        bins = scene.distribution.label_of(part.draw)
        rendered = one_each([part], [nuisance], [label], [bins], scene.synthesizer)
        images, first = rendered.images, torch.zeros(1, dtype=torch.long)
        targets = loop.detector.assign(images.boxes, images.labels)
        losses = image_losses(loop.detector, loop.backbone, targets, images.labels)
        pulled = input_cotangents(
            losses, loop.trainable, loop.vector, (images.images,), first, torch.ones(1),
            mode=estimator.theta_mode,
        )  # fmt: skip
        path = rendered_path(scene, label, part, rendered.compose[0])
        return _Image(loop, label, seed, replace(part, tangents=None), map_cotangents(path, *pulled))

    @property
    def device(self) -> torch.device:
        return self.cotangents.rgb.device

    def peak(self, run: Callable[[], object]) -> float:
        """MiB."""
        return peak_bytes(run, self.device) / 2**20

    def render(self, tangents: bool) -> RenderedObject:
        relaxed = self.part.relaxed
        how = replace(relaxed, tangents=tangents) if relaxed is not None else HARD
        return self.loop.scene.drawn(self.label, self.loop.psi[self.label], 1, _generator(self.seed), how)

    def forward(self) -> dict[str, Tensor]:
        return contract(self.render(tangents=True).tangents or {}, self.cotangents)

    def reverse(self, patch: int) -> dict[str, Tensor]:
        scene = self.loop.scene
        field, draw = scene.fields[self.label], self.part.draw
        return draw_cotangents(
            lambda rays: scene.renderer.render_rays(field, rays), scene.camera, draw, self.cotangents, patch
        )

    def output_mb(self) -> float:
        """MiB of the maps and their derivatives, each as large as the cotangents."""
        maps = (self.cotangents.rgb, self.cotangents.opacity)
        each = sum(values.numel() * values.element_size() for values in maps)
        return each * (1 + len(self.forward())) / 2**20


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _apart(values: Mapping[str, Tensor], truth: Mapping[str, Tensor]) -> float:
    """Distance over the numbers that ``truth`` has, relative to its norm."""
    one, other = (torch.cat([each[name] for name in truth]) for each in (values, truth))
    return float((one - other).norm() / other.norm())

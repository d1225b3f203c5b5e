"""Error of rendered images against the pixels and samples that a renderer skips."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from jaxtyping import Float
from torch import Tensor

from neural_sim import cameras
from neural_sim.field.base import RadianceField
from neural_sim.field.pixels import seen_pixels
from neural_sim.ranges import Fraction, Positive, PositiveInt, validated
from neural_sim.renderer.nerf import NerfRenderer, Quality
from neural_sim.studies.work_precision.measurement import Point, Series, Timing, World
from neural_sim.types import PinholeCamera, Rays

SHOWN = 0.01
"""Opacity above which a pixel, in either image, shows the object; errors of opacity are means over such pixels."""
FIELD_OF_VIEW = math.radians(40.0)


@dataclass(frozen=True)
class Left:
    """What a renderer skipped in an image of one object, and the resulting errors.

    ``opacity`` is the mean error over the pixels that show the object, ``colour`` the root mean square error of
    premultiplied colour over all pixels; ``cast`` is the fraction of pixels whose rays were cast, ``samples`` the
    number of samples per ray that hits.
    """

    opacity: float
    colour: float
    cast: float
    samples: float


def variants(
    renderer: NerfRenderer, terminations: Sequence[float], steps: Sequence[float]
) -> dict[str, NerfRenderer]:
    """Make renderers by ``line, setting``: all qualities, and the run's own with one saving undone or changed."""
    own: dict[str, object] = {"termination": renderer.termination, "step": renderer.step}
    own |= {"cull": renderer.cull, "skip_empty": renderer.skip_empty}

    def other(**changed: object) -> NerfRenderer:
        return type(renderer)(renderer.quality, renderer.rays_per_chunk, **{**own, **changed})  # pyright: ignore[reportArgumentType]

    made = {f"quality, {quality}": renderer.at(quality) for quality in get_args(Quality)}
    made |= {
        "undone, every pixel": other(cull=False),
        "undone, every step": other(skip_empty=False),
        "undone, every sample": other(termination=0.0),
    }
    made |= {f"termination, {value:g}": other(termination=value) for value in terminations}
    return made | {f"step, {value:g}": other(step=value) for value in steps}


def left_out(
    field: RadianceField, renderer: NerfRenderer, camera: PinholeCamera, poses: Float[Tensor, "views 4 4"]
) -> Left:
    """Compare with a render of the same field that skips nothing, at the step of the field."""
    rgb, opacity = renderer.render(field, camera, poses)
    every_rgb, every_opacity = renderer.render(field, camera, poses, exact=True)
    shown = (opacity > SHOWN) | (every_opacity > SHOWN)
    bundle = cameras.rays(camera, poses[:1])
    rays = Rays(bundle.origins.reshape(-1, 3), bundle.directions.reshape(-1, 3))
    samples = field.with_step(renderer.step).sample(rays, renderer.termination)
    hit = int((samples.starts.diff() > 0).sum())
    cast = sum(len(seen.pixel) for seen in seen_pixels(field, camera, poses, 65536, renderer.cull))
    return Left(
        float((opacity - every_opacity).abs()[shown].mean()) if bool(shown.any()) else math.nan,
        float((rgb - every_rgb).square().mean().sqrt()),
        cast / (len(poses) * camera.width * camera.height),
        len(samples) / max(hit, 1),
    )


@validated
@dataclass(frozen=True)
class Renderer:
    """The family ``renderer``.

    Args:
        size: pixels per side.
        views: number of held-out poses to render.
        terminations: transmittances below which samples are skipped.
        steps: multiples of the field's step.
    """

    size: PositiveInt = 96
    views: PositiveInt = 4
    terminations: tuple[Fraction, ...] = (1e-4, 3e-3, 3e-2, 1e-1)
    steps: tuple[Positive, ...] = (1.5, 3.0)

    def measure(self, world: World, timing: Timing, seed: int) -> Iterator[Series]:
        """Measure means over the objects of the run; seconds are per image."""
        del seed  # nothing is random
        poses = world.views.camera_to_world[-world.held_out :][: self.views]
        camera = PinholeCamera(self.size, self.size, FIELD_OF_VIEW)
        named = variants(world.renderer, self.terminations, self.steps)
        found = {name: self._means(world.fields, one, camera, poses, timing) for name, one in named.items()}
        note = (
            f"Images of {self.size} x {self.size} pixels from {len(poses)} views of {', '.join(world.names)}, against "
            "renders with nothing left out, at the field's own step; seconds are per image."
        )
        for kind, label in (
            ("opacity", "mean error of opacity"),
            ("colour", "root mean square error of colour"),
        ):
            points = tuple(
                self._point(name, row, kind, world.renderer.quality) for name, row in found.items()
            )
            yield Series(f"renderer/{kind}", label, points, (), note, timing.clock)

    def _means(
        self, fields: Sequence[RadianceField], renderer: NerfRenderer, camera: PinholeCamera, poses: Tensor,
        timing: Timing,
    ) -> Mapping[str, float]:  # fmt: skip
        rows = []
        for field in fields:
            device = next(field.parameters()).device
            at = poses.to(device)
            seconds, memory = timing.of(lambda f=field, p=at: renderer.render(f, camera, p), device)
            memory = math.nan if memory is None else memory
            rows.append(
                {
                    **vars(left_out(field, renderer, camera, at)),
                    "seconds": seconds / len(at),
                    "memory": memory,
                }
            )
        return {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}

    def _point(self, name: str, row: Mapping[str, float], kind: str, quality: str) -> Point:
        detail = f"{row['cast']:.0%} of the pixels, {row['samples']:.1f} samples per ray that hits"
        default = name == f"quality, {quality}"
        memory = None if math.isnan(row["memory"]) else row["memory"]
        return Point(name, row[kind], row["seconds"], memory, default, name.partition(",")[0], detail)

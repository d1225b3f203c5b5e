"""Interpolation between two lights of a field, which changes colour but not geometry (the paper's Sec. A.6)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Gt
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor
from typing_extensions import override

from neural_sim.cameras import orbit
from neural_sim.documents import markdown_table
from neural_sim.field.base import RadianceField
from neural_sim.ranges import Distinct, PositiveInt, validated
from neural_sim.renderer.nerf_w import NerfWRenderer
from neural_sim.report.figures import MUTED, picture, titled
from neural_sim.report.tracking import Run
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task
from neural_sim.types import PinholeCamera

UNCHANGED = 1e-6
"""Largest difference in opacity between lights that counts as none."""


@dataclass(frozen=True)
class InterpolatedViews:
    """One object's images between two lights.

    ``opacity_change`` is the largest change of opacity from the first image, over all pixels.
    """

    images: Float[Tensor, "steps height width 3"]
    opacity_change: float


@validated
@dataclass(frozen=True)
class Interpolation(Task):
    """``+experiment=illumination_interpolation``: render every object under lights from one anchor light to another.

    Args:
        ends: numbers of the two anchor lights, from 1.
        steps: number of images, including both ends.
        image_size: side of the images in pixels.
        phi_deg: first angle of the camera in degrees, see ``neural_sim.cameras.orbit``.
        rho_deg: second angle of the camera in degrees.
        distance: distance of the camera in object radii.
    """

    ends: Annotated[tuple[PositiveInt, PositiveInt], Distinct()] = (1, 5)
    steps: Annotated[int, Ge(2)] = 7
    image_size: PositiveInt = 128
    phi_deg: float = 75.0
    rho_deg: float = 30.0
    distance: Annotated[float, Gt(1)] = 3.0

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        self._lights(context)
        return context.graph.fields

    def _lights(self, context: Context) -> int:
        """Return the number of anchor lights."""
        rig = context.experiment.imaging.views.rig
        if rig is None:
            raise ValueError("interpolation: want renderer=nerf_w; with any other, the light is fixed")
        if max(self.ends) > rig.anchors:
            raise ValueError(
                f"interpolation.ends: there are {rig.anchors} anchor lights, got {list(self.ends)}"
            )
        return rig.anchors

    @override
    def run(self, context: Context) -> None:
        views, anchors = context.experiment.imaging.views, self._lights(context)
        scene, camera = context.results(context.graph.scene), views.camera(self.image_size)
        place = [math.radians(self.phi_deg), math.radians(self.rho_deg), self.distance]
        pose = orbit(*(torch.tensor(value) for value in place))
        one, other = (torch.eye(anchors)[end - 1] for end in self.ends)
        shown = {
            shown.name: interpolate(shown.field, shown.lit_renderer, camera, pose, (one, other), self.steps)
            for shown in scene.fields
        }
        publish(context, shown, "From light {} to light {}".format(*self.ends))


def interpolate(
    field: RadianceField,
    renderer: NerfWRenderer,
    camera: PinholeCamera,
    camera_to_world: Float[Tensor, "4 4"],
    ends: tuple[Float[Tensor, "k"], Float[Tensor, "k"]],
    steps: int = 7,
) -> InterpolatedViews:
    """Render images over white from one camera, under ``steps`` evenly spaced weights from one end to the other.

    Raises:
        RuntimeError: opacity changes by more than ``UNCHANGED``, although the light must not affect the density.
    """
    parts = torch.linspace(0.0, 1.0, steps).to(ends[0])
    images, opacities, pose = [], [], camera_to_world.to(next(field.parameters()).device)
    for part in parts:
        weights = torch.lerp(ends[0], ends[1], part)[None]
        rgb, opacity = renderer.render(field, camera, pose[None], weights=weights)
        images.append(rgb[0] + (1.0 - opacity[0])[..., None])
        opacities.append(opacity[0])
    change = float((torch.stack(opacities) - opacities[0]).abs().max())
    if not change <= UNCHANGED:
        raise RuntimeError(f"interpolate: opacity changes by {change:.3g} with the light, want {UNCHANGED:g}")
    return InterpolatedViews(torch.stack(images).clamp(0.0, 1.0).cpu(), change)


def publish(context: Context, views: Mapping[str, InterpolatedViews], title: str) -> Run | None:
    """Write interpolation.json, interpolation.md and the figure, and log the changes of opacity to MLflow."""
    changes = {name: own.opacity_change for name, own in views.items()}
    drawn = {"interpolation": interpolation_figure(views, title)}
    metrics = {f"{name}/opacity_change": change for name, change in changes.items()}
    document = {"opacity_change": changes}
    return context.publish("interpolation", document, table(views, title), drawn, metrics)


def table(views: Mapping[str, InterpolatedViews], title: str) -> str:
    """Return a Markdown table of the changes of opacity and colour between the lights."""
    count = len(next(iter(views.values())).images)
    head = ["object", "largest change of opacity", "mean change of colour from the first light to the last"]
    rows = [
        (name, f"{own.opacity_change:.0e}", f"{float((own.images[-1] - own.images[0]).abs().mean()):.3f}")
        for name, own in views.items()
    ]
    note = f"{title}: {count} images from one camera. Colours and opacities range from 0 to 1."
    return f"{note}\n\n{markdown_table(head, rows)}"


def interpolation_figure(views: Mapping[str, InterpolatedViews], title: str) -> Figure:
    """Draw a row per object, from the first light on the left to the second on the right."""
    count, height, width = next(iter(views.values())).images.shape[:3]
    canvas = np.concatenate(
        [np.concatenate(list(row.images.cpu().numpy()), axis=1) for row in views.values()], axis=0
    )
    named = 0.2 + 0.07 * max(map(len, views))  # inches that the longest name takes
    across, down = 1.4 * count + named, 1.4 * len(views) + 0.8
    figure = Figure(figsize=(across, down))
    axes = figure.add_axes(
        (named / across, 0.35 / down, 1.4 * count / across - 0.01, 1.4 * len(views) / down)
    )
    picture(axes, canvas)
    axes.set_yticks([(row + 0.5) * height for row in range(len(views))], list(views))
    fractions = [f"{i / (count - 1):.2g}" for i in range(count)]
    axes.set_xticks([(column + 0.5) * width for column in range(count)], fractions)
    axes.tick_params(length=0, colors=MUTED, labelsize=8)
    change = max(row.opacity_change for row in views.values())
    titled(figure, f"{title} (opacity changes by at most {change:.0e})", 10)
    return figure

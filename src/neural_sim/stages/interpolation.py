"""Stage ``interpolation``: images between two lights, as conf/experiment/illumination_interpolation.yaml says."""

from __future__ import annotations

import json
from dataclasses import dataclass

from neural_sim.report import figures
from neural_sim.report.interpolation import Interpolation, interpolation_figure
from neural_sim.stages.context import Context


@dataclass(frozen=True)
class InterpolationStep(Interpolation):
    """See :class:`Interpolation`."""

    def run(self, context: Context) -> None:
        """The figure, and how little opacity changed, to the run's folder.

        Raises:
            ValueError: a light that is fixed.
        """
        views, folder = context.experiment.imaging.views, context.folder
        if views.rig is None:
            raise ValueError("interpolation: want renderer=nerf_w, the light is fixed")
        scene = context.results(context.graph.scene)
        fields = dict(zip(scene.names, scene.fields, strict=True))
        interpolated = self.interpolated_views(
            fields, scene.lit_renderer, views.camera(self.image_size), views.rig.anchors
        )
        title = "From light {} to light {}".format(*self.ends)
        figures.save(interpolation_figure(interpolated, title), folder / "figures" / "interpolation.png")
        changes = {name: images.opacity_change for name, images in interpolated.items()}
        (folder / "interpolation.json").write_text(json.dumps({"opacity_change": changes}, indent=1))
        print(f"largest change of opacity: {max(changes.values()):.1e}\nresults: {folder}")

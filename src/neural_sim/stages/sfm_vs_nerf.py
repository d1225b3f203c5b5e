"""Stage ``sfm_vs_nerf``: fields against meshes reconstructed from the same views, as conf/experiment/sfm_vs_nerf.yaml
says.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from neural_sim.alpha import over_white, premultiplied
from neural_sim.checks import at_least
from neural_sim.field.hull import COARSEST
from neural_sim.field.scores import compare, where_known
from neural_sim.objects.mesh import ObjectMesh, content_digest
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.subject import FieldSubject, MeshSubject, Subject
from neural_sim.renderer.views import choose_mesh_renderer
from neural_sim.report.reconstruction import HeldOut, held_out_figure, held_out_table
from neural_sim.report.side_by_side import report_side_by_side
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.other_images import trained_on
from neural_sim.stages.reconstruction import ReconstructionDetectorStage, ReconstructionStage
from neural_sim.stages.side_by_side import compare_sources, graphs_of_seeds, pairs, results_of_study
from neural_sim.stages.stage import Results
from neural_sim.tasks.context import Context
from neural_sim.types import PosedViews

UNLIT = Lighting(lights=(), ambient=1.0)
"""The colours of a reconstruction have the light of its views."""


@dataclass(frozen=True)
class SfmVsNerfStep:
    """The paper's Sec. A.5: what a reconstructed mesh lacks beside a field, on held-out views and as training images.

    Args:
        resolution: cells of the reconstruction along the unit sphere's diameter, a power of two from 32.
        seeds: how many detectors of each kind, from the run's seed on.
        draws: of the bootstrap over test images.
        shown: training images of each kind in the figure.

    Raises:
        ValueError: numbers below their least, or another resolution.
    """

    resolution: int = 128
    seeds: int = 5
    draws: int = 300
    shown: int = 8

    def __post_init__(self) -> None:
        at_least("sfm_vs_nerf", 1, seeds=self.seeds, shown=self.shown)
        at_least("sfm_vs_nerf", 2, draws=self.draws)
        if self.resolution < COARSEST or self.resolution & (self.resolution - 1):
            raise ValueError(
                f"sfm_vs_nerf.resolution must be a power of two from {COARSEST}, got {self.resolution}"
            )

    def run(self, context: Context) -> None:
        """PSNR on held-out views, AP, and figures of both; to the run's folder and MLflow.

        Raises:
            ValueError: no held-out view.
        """
        x, begun, results = context.experiment, time.time(), results_of_study(context)
        graphs, names = graphs_of_seeds(context, self.seeds), list(context.graph.names)
        if not x.imaging.views.held_out:
            raise ValueError("sfm_vs_nerf: want views.held_out of at least 1, got 0")
        stages = tuple(ReconstructionStage(views, self.resolution) for views in graphs[0].views)
        meshes = self._meshes(graphs[0], stages, results)
        objects = [self._held_out(graphs[0], results, i, mesh) for i, mesh in enumerate(meshes)]

        def sources(graph: Graph) -> dict[str, DetectorStage]:
            nerf = graph.synthetic(graph.psi("target"), "images of the fields")
            more = {"reconstructions": stages, "subjects": meshes}
            return {"nerf": nerf, "sfm": trained_on(nerf, ReconstructionDetectorStage, **more)}

        found = compare_sources(graphs, results, sources, lambda graph: {"test": graph.targets}, self.draws)
        scores = {each.object: dict(each.scores) for each in objects}
        run = report_side_by_side(
            found, pairs(graphs[0], results, sources(graphs[0]), self.shown), names,
            "Detectors trained on images of fields (nerf) and of meshes reconstructed from the same views (sfm).",
            x.run.name, x.config, context.uri, context.folder, begun,
            {"held_out": scores}, held_out_table(objects), {"held_out": held_out_figure(objects)},
        )  # fmt: skip
        print(f"results: {context.folder}\n{run.where}")

    def _meshes(
        self, graph: Graph, stages: tuple[ReconstructionStage, ...], results: Results
    ) -> tuple[MeshSubject, ...]:
        views = graph.experiment.imaging.views
        renderer = choose_mesh_renderer(views.backend, views.supersample, UNLIT)
        made = {stage.views.object: results(stage) for stage in stages}
        return tuple(
            MeshSubject(ObjectMesh(name, mesh, np.eye(4), content_digest(mesh)), renderer)
            for name, mesh in made.items()
        )

    def _held_out(self, graph: Graph, results: Results, label: int, mesh: Subject) -> HeldOut:
        """Held-out views of an object, as they are, by its field, and by its reconstruction."""
        views = results(graph.views[label])
        unseen = views.select(torch.arange(len(views) - graph.views[label].held_out, len(views)))
        renderer = graph.experiment.imaging.renderer
        field = FieldSubject(mesh.name, results(graph.fields[label]).field, renderer=renderer)
        shown: Mapping[str, Subject] = {"nerf": field, "sfm": mesh}
        rendered = {name: _as_seen(each, unseen) for name, each in shown.items()}
        scores = {name: compare(image, unseen.images) for name, image in rendered.items()}
        rendered = {"view": premultiplied(unseen.images), **rendered}
        return HeldOut(mesh.name, {name: over_white(image[0]) for name, image in rendered.items()}, scores)


def _as_seen(subject: Subject, views: PosedViews) -> torch.Tensor:
    return where_known(premultiplied(subject.render(views.camera, views.camera_to_world)), views)

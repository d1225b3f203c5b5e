"""Fields against meshes reconstructed from the same views, on held-out views and as training images (Sec. A.5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor
from typing_extensions import override

from neural_sim.alpha import over_white, premultiplied
from neural_sim.documents import markdown_table
from neural_sim.field.hull import Resolution
from neural_sim.field.scores import compare, where_known
from neural_sim.ranges import PositiveInt, validated
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.views import choose_mesh_renderer
from neural_sim.report.figures import INK, picture, titled
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.reconstruction import ReconstructionStage, ReconstructionSubjectStage
from neural_sim.stages.stage import Results, Stage
from neural_sim.studies.sources import Samples, compare_sources, graphs_of_seeds, publish
from neural_sim.synthesis.subjects import PhotographedField, RenderedSubject
from neural_sim.tasks.context import Context, Task
from neural_sim.types import PosedViews

UNLIT = Lighting(lights=(), ambient=1.0)
"""The colours of a reconstruction already contain the light of its views."""


@dataclass(frozen=True)
class HeldOut:
    """One object in views that neither its field nor its reconstruction was made from.

    ``images`` are the first of these views (``view``) and the renders of it by each source, over white. ``scores`` are
    the ``psnr``, ``psnr_foreground`` (dB) and ``ssim`` of each source over all of them.
    """

    object: str
    images: Mapping[str, Float[Tensor, "_ _ 3"]]
    scores: Mapping[str, Mapping[str, float]]


@validated
@dataclass(frozen=True)
class SfmVsNerf(Task):
    """``+experiment=sfm_vs_nerf``: compare fields with reconstructed meshes.

    Args:
        resolution: cells of the reconstruction along the diameter of the unit sphere.
        seeds: number of detectors of each source; seeds count up from the run's.
        draws: bootstrap draws over test images.
        shown: number of training images of each source in the figure.
    """

    resolution: Resolution = 128
    seeds: PositiveInt = 5
    draws: Annotated[int, Ge(2)] = 300
    shown: PositiveInt = 8

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        if not context.experiment.imaging.views.held_out:
            raise ValueError("sfm_vs_nerf: want views.held_out of at least 1, got 0")
        graphs = graphs_of_seeds(context, self.seeds)
        meshes = self._reconstructions(graphs[0])
        detectors = [stage for graph in graphs for stage in self._sources(graph, meshes).values()]
        return [*meshes, *(graph.targets for graph in graphs), *detectors]

    def _reconstructions(self, graph: Graph) -> tuple[ReconstructionSubjectStage, ...]:
        views = graph.experiment.imaging.views
        renderer = choose_mesh_renderer(views.backend, views.supersample, UNLIT)
        radii = graph.radii or (None,) * len(graph.names)
        return tuple(
            ReconstructionSubjectStage(ReconstructionStage(each, self.resolution), radius, renderer)
            for each, radius in zip(graph.views, radii, strict=True)
        )

    def _sources(
        self, graph: Graph, meshes: tuple[ReconstructionSubjectStage, ...]
    ) -> dict[str, DetectorStage]:
        nerf = graph.synthetic(graph.psi("target"), "images of the fields")
        return {"nerf": nerf, "sfm": replace(nerf, scene=graph.scene.showing(meshes))}

    @override
    def run(self, context: Context) -> None:
        graphs, results = graphs_of_seeds(context, self.seeds), context.results
        meshes = self._reconstructions(graphs[0])
        objects = [self._held_out(graphs[0], results, i, results(mesh)) for i, mesh in enumerate(meshes)]

        def sources(graph: Graph) -> dict[str, DetectorStage]:
            return self._sources(graph, meshes)

        found = compare_sources(graphs, results, sources, lambda graph: {"test": graph.targets}, self.draws)
        samples = Samples.of(results, sources(graphs[0]), self.shown)
        heading = "Detectors trained on images of fields (nerf) and of meshes reconstructed from the same views (sfm)."
        more = {"held_out": {each.object: dict(each.scores) for each in objects}}
        publish(context, found, samples, heading, more, held_out_table(objects), held_out_figure(objects))

    def _held_out(self, graph: Graph, results: Results, label: int, mesh: RenderedSubject) -> HeldOut:
        """Render an object's held-out views with its field and with its reconstruction, and score the renders."""
        views = results(graph.views[label])
        unseen = views.select(torch.arange(len(views) - graph.views[label].held_out, len(views)))
        renderer = graph.experiment.imaging.renderer
        field = PhotographedField(mesh.name, results(graph.fields[label]).field, renderer)
        shown: Mapping[str, RenderedSubject] = {"nerf": field, "sfm": mesh}
        rendered = {name: _as_seen(each, unseen) for name, each in shown.items()}
        scores = {name: compare(image, unseen.images) for name, image in rendered.items()}
        rendered = {"view": premultiplied(unseen.images), **rendered}
        return HeldOut(mesh.name, {name: over_white(image[0]) for name, image in rendered.items()}, scores)


def _as_seen(subject: RenderedSubject, views: PosedViews) -> Float[Tensor, "views h w 4"]:
    return where_known(subject.maps(views.camera, views.camera_to_world).rgba, views)


def held_out_table(objects: Sequence[HeldOut]) -> str:
    """Return a Markdown table of PSNR by object, and its mean, for whole images and for the object's pixels."""
    sources = list(objects[0].scores)
    rows = {
        each.object: [each.scores[s][key] for s in sources for key in ("psnr", "psnr_foreground")]
        for each in objects
    }
    rows["mean"] = np.mean(list(rows.values()), 0).tolist()
    head = ["object", *(name for source in sources for name in (source, f"{source}, object"))]
    cells = [[name, *(f"{value:.1f}" for value in row)] for name, row in rows.items()]
    note = "PSNR in dB on held-out views, of whole images over white and of the object's pixels alone."
    return f"{note}\n\n{markdown_table(head, cells)}"


def held_out_figure(objects: Sequence[HeldOut]) -> Figure:
    """Draw one column per object, with its view in the first row and one row for each source below."""
    rows = list(objects[0].images)
    figure = Figure(figsize=(1.6 * len(objects) + 0.5, 1.75 * len(rows) + 0.5), layout="constrained")
    grid = figure.subplots(len(rows), len(objects), squeeze=False)
    for column, each in enumerate(objects):
        for line, name in enumerate(rows):
            axes = grid[line, column]
            picture(axes, each.images[name].clamp(0.0, 1.0).cpu().numpy())
            if name in each.scores:
                axes.set_xlabel(f"{each.scores[name]['psnr']:.1f} dB", color=INK, fontsize=8)
        grid[0, column].set_title(each.object, color=INK, fontsize=9)
    for line, name in enumerate(rows):
        grid[line, 0].set_ylabel(name, color=INK, fontsize=9)
    titled(figure, "One held-out view of each object; PSNR over all of them")
    return figure

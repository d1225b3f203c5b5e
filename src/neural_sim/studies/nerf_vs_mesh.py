"""Fields against the mesh renderer as sources of training images (the paper's Secs. 4.1 and A.2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge
from typing_extensions import override

from neural_sim.ranges import Ascending, NonNegativeInt, PositiveInt, validated
from neural_sim.report.detections import write_training_set
from neural_sim.stages.detector import DetectorStage
from neural_sim.stages.graph import Graph
from neural_sim.stages.scene import LoadedImagesStage, MeshSubjectStage
from neural_sim.stages.stage import Stage
from neural_sim.stages.target_sets import TargetSetsStage
from neural_sim.studies.sources import Samples, compare_sources, graphs_of_seeds, publish
from neural_sim.target.coco import CocoTarget
from neural_sim.tasks.context import Context, Task

ANNOTATIONS = ("coco_annotations.json", "coco_data/coco_annotations.json")
"""Files in an output folder that BlenderProc's ``write_coco_annotations`` may have written."""


@validated
@dataclass(frozen=True)
class NerfVsMesh(Task):
    """``+experiment=nerf_vs_mesh``: compare detectors trained on images of fields and on images of meshes.

    Both sources render the same poses and distances. All detectors are scored on images of one and of several objects.

    Args:
        single: fewest and most objects per image in the first test set.
        multiple: fewest and most objects per image in the second test set.
        seeds: number of detectors of each source; seeds count up from the run's.
        blenderproc: folder with BlenderProc's COCO output, whose images replace those of the mesh renderer; None: the
            mesh renderer.
        categories: object name by BlenderProc's category name, null to leave the category out. A category that is not
            listed is the object of the same name.
        draws: bootstrap draws over test images.
        shown: number of training images of each source in the figure.

    Raises:
        ValueError: the folder has no BlenderProc annotations.
    """

    single: Annotated[tuple[NonNegativeInt, PositiveInt], Ascending()] = (1, 1)
    multiple: Annotated[tuple[NonNegativeInt, PositiveInt], Ascending()] = (2, 4)
    seeds: PositiveInt = 5
    blenderproc: str | None = None
    categories: Mapping[str, str | None] | None = None
    draws: Annotated[int, Ge(2)] = 300
    shown: PositiveInt = 8

    def __post_init__(self) -> None:
        _ = self._rendered  # a folder without annotations is refused before anything is computed

    @cached_property
    def _rendered(self) -> CocoTarget | None:
        if self.blenderproc is None:
            return None
        folder = Path(self.blenderproc).expanduser()
        found = [folder / name for name in ANNOTATIONS if (folder / name).is_file()]
        if not found:
            raise ValueError(
                f"nerf_vs_mesh.blenderproc: want a folder that BlenderProc's write_coco_annotations wrote; no "
                f"{' or '.join(ANNOTATIONS)} in {folder}"
            )
        return CocoTarget(found[0], categories=self.categories)

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        if not context.graph.objects.has_meshes:
            raise ValueError("nerf_vs_mesh: want objects with meshes; objects=photos has none")
        if not context.experiment.imaging.target.renders:
            raise ValueError("nerf_vs_mesh: want target=rendered; its test images are renders of meshes")
        for graph in graphs_of_seeds(context, self.seeds):
            yield from self.tests(graph).values()
            yield from self.sources(graph).values()

    @override
    def run(self, context: Context) -> None:
        graphs, results = graphs_of_seeds(context, self.seeds), context.results
        found = compare_sources(graphs, results, self.sources, self.tests, self.draws)
        sources, names = self.sources(graphs[0]), list(context.graph.names)
        write_training_set(sources["nerf"].images(results), names, context.folder / "training_set")
        heading = f"Detectors trained on images of fields (nerf) and of meshes ({found.sources[1]})."
        publish(context, found, Samples.of(results, sources, self.shown), heading)

    def tests(self, graph: Graph) -> dict[str, TargetSetsStage]:
        """Return the test sets by name."""
        synthesis = graph.experiment.imaging.synthesis
        return {
            name: replace(graph.targets, synthesizer=replace(synthesis, objects_per_image=tuple(count)))
            for name, count in (("single", self.single), ("multiple", self.multiple))
        }

    def sources(self, graph: Graph) -> dict[str, DetectorStage]:
        """Return the detectors to compare, by the source of their training images."""
        nerf = graph.synthetic(graph.psi("target"), "images of the fields")
        if self._rendered is not None:
            loaded = LoadedImagesStage(self._rendered, graph.names, graph.camera)
            return {"nerf": nerf, "blenderproc": replace(nerf, scene=loaded)}
        supersample, objects = graph.experiment.imaging.views.supersample, graph.objects
        meshes = tuple(
            MeshSubjectStage(name, objects.digests[name], supersample, objects) for name in graph.names
        )
        return {"nerf": nerf, "mesh": replace(nerf, scene=graph.scene.showing(meshes))}

"""Task ``export``: write a data set of annotated images of any size, drawn from a distribution."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
from annotated_types import Ge, Lt, MinLen
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from neural_sim.cameras import reframed
from neural_sim.digests import digest
from neural_sim.parameter.product import SceneDistribution
from neural_sim.ranges import Distinct, NonNegativeInt, PositiveInt, With, validated
from neural_sim.report.page.samples import write_samples_page
from neural_sim.stages.describe import describe, modules_of
from neural_sim.stages.detail import cost_of, finer_fields
from neural_sim.stages.psi_file import psi_of_file
from neural_sim.stages.stage import Stage
from neural_sim.stages.store import Store, locked
from neural_sim.stages.version import code_version
from neural_sim.stages.views import Meshes, Objects
from neural_sim.synthesis.export.bop import Model
from neural_sim.synthesis.export.dataset import DataSet, Format, ImageFormat
from neural_sim.synthesis.export.folder import MANIFEST, ExportFolder, opencv_entry, write_json, write_whole
from neural_sim.synthesis.export.images import ImageSource
from neural_sim.synthesis.export.psi_table import psi_csv, psi_rows
from neural_sim.tasks.context import Context, Task
from neural_sim.types import PinholeCamera
from neural_sim.workers import Workers

_log = logging.getLogger(__name__)

UNKNOWN_RADIUS = 100.0
"""Radius in millimetres assumed in BOP files for objects of unknown size."""
MADE = ("psi", "millimetres_per_radius", "fields")
"""Parts of a data set's identity that are known once psi is learned and the objects are loaded."""
Part = Annotated[float, Ge(0), Lt(1)]


@validated
@dataclass(frozen=True)
class ExportTask(Task):
    """A data set of ``count`` images. See ``docs/use.md``, Export a data set.

    Args:
        count: number of images. If the folder has some already, only the missing ones are added.
        psi: ``learned``, ``initial``, ``target``, or a file: a run's folder or its ``results.json`` (its learned psi),
            or the ``psi.json`` of an export.
        width, height: image size in pixels; null: the size of the run's synthesised images.
        formats: some of ``coco``, ``yolo`` and ``bop``.
        val_fraction: fraction of the images for validation, for the split of COCO and YOLO; 0: no split.
        empty_fraction: fraction of the images that show no object.
        folder: output folder; null: ``dataset`` in the run's folder.
        image_format: ``jpg`` (quality 95, no chroma subsampling) or ``png``.
        detail: ``auto`` fits finer fields to larger views if the images are too large for the run's fields; ``run``
            uses the run's fields.
        largest_views: largest side, in pixels, of the views for ``detail=auto``.
        scene_size: images per BOP scene.
        workers: number of processes; 0: this process alone; null: this process alone on a GPU, and on a CPU the cluster
            if the run has one, else one process per core.
    """

    count: PositiveInt = 1000
    psi: str = "learned"
    width: Annotated[Annotated[int, Ge(8)] | None, With("height")] = None
    height: Annotated[int, Ge(8)] | None = None
    formats: Annotated[Sequence[Format], MinLen(1), Distinct()] = ("coco",)
    val_fraction: Part = 0.1
    empty_fraction: Part = 0.0
    folder: str | None = None
    image_format: ImageFormat = "jpg"
    detail: Literal["auto", "run"] = "auto"
    largest_views: PositiveInt = 384
    scene_size: PositiveInt = 1000
    workers: NonNegativeInt | None = None

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        self._check_images(context)
        self._workers(context)
        fields = graph.fields if self.detail == "run" else ()
        ExportFolder(self._root(context), self._settings(context)).check(unknown=MADE)
        if self.psi == "learned":
            return [*fields, graph.learned]
        self._psi(context)  # raises if the distribution is unknown or its file is unfit
        return fields

    @override
    def run(self, context: Context) -> None:
        root = self._root(context)
        data, distribution = self._data_set(context, root), context.experiment.imaging.distribution
        root.parent.mkdir(parents=True, exist_ok=True)
        with locked(_lock_of(root), key="export.folder"), self._resuming(context, data):
            records = data.write(lambda numbers: context.shown(numbers, "export"))
            rows = psi_rows(distribution, data.source.psi, data.source.scene.names)
            write_whole(root / "psi.csv", psi_csv(rows))
            write_json(root / "psi.json", {"rows": rows, **_psi_identity(data)}, indent=1)
            page = write_samples_page(root, records, data.source.scene.names, data.parts(records))
        labelled = sum(item["labelled"] for record in records for item in record["objects"])
        print(
            f"{len(records)} images with {labelled} labelled objects\ndata set: {root}\nwhat is in it? open {page}"
        )

    def _root(self, context: Context) -> Path:
        return context.folder / "dataset" if self.folder is None else Path(self.folder).expanduser().resolve()

    def _check_images(self, context: Context) -> None:
        imaging = context.experiment.imaging
        imaging.synthesis.count.check(len(context.graph.names))
        zooms = any(factor.coordinate == "magnification" for factor in imaging.distribution.binned)
        if "bop" in self.formats and zooms and imaging.synthesis.count.most > 1:
            raise ValueError(
                "export.formats: bop has one camera for all objects of an image, and parameter.zoom.by=focal_length "
                "gives each its own; want other formats, parameter.zoom.by=distance, or "
                "synthesis.objects_per_image=[1, 1]"
            )

    def _data_set(self, context: Context, root: Path) -> DataSet:
        x, graph = context.experiment, context.graph
        camera, workers = self._camera(context), self._workers(context)
        psi, models = self._psi(context), models_of(graph.objects)
        stages = graph.fields if self.detail == "run" else finer_fields(graph, camera, self.largest_views)
        scene = graph.scene.showing(graph.subjects(stages, x.imaging.renderer))
        millimetres = tuple(model.millimetres for model in models)
        identity = self._settings(context) | {
            "psi": _rounded_probabilities(x.imaging.distribution, psi, graph.names),
            "millimetres_per_radius": list(millimetres),
            "fields": [stage.key for stage in stages],
        }
        ExportFolder(root, identity).check()  # before finer fields are fitted, which may take minutes
        if cost := cost_of(stages, graph.fields, context.results):
            _log.info("export: %s", cost)
        for stage in context.results.free_first(context.shown(stages, "field")):
            context.results(stage)
        source = ImageSource(
            context.results(scene), psi, camera, millimetres, x.run.seed, self.empty_fraction
        )
        return DataSet(
            source, root, models, identity, self.count, cast(Sequence[Format], tuple(self.formats)),
            self.image_format, self.scene_size, farthest(source), workers, self.val_fraction,
        )  # fmt: skip

    @contextmanager
    def _resuming(self, context: Context, data: DataSet) -> Iterator[None]:
        """Resume the data set of a killed run of the same command, and note in the store where this run writes.

        Each run of the command has a note, which is removed when its data set is finished.
        """
        if self.folder is not None:  # a folder that the user names is resumed in place
            yield
            return
        run, what = context.experiment.run, {"count": self.count, "formats": list(self.formats)}
        store, key = Store(run.store), digest({**what, "identity": data.identity})
        own, notes = str(data.root.resolve()), (store.state("export", key) or {}).get("folders", ())
        moved = None
        if run.resume and not data.root.exists():
            moved = next((folder for folder in reversed(notes) if _move_unfinished(Path(folder), data)), None)

        def noted(state: Any, *ours: str) -> dict[str, list[str]] | None:
            """Return the notes of the other runs whose folders still exist, and our own."""
            held = (state or {}).get("folders", ())
            others = [f for f in held if f not in (own, moved) and Path(f).parent.is_dir()]
            return {"folders": [*others, *ours]} if others or ours else None

        store.revise("export", key, lambda state: noted(state, own))
        yield
        store.revise("export", key, noted)

    def _psi(self, context: Context) -> Float[Tensor, "objects K"]:
        graph, distribution = context.graph, context.experiment.imaging.distribution
        if self.psi == "learned":
            return context.results(graph.learned).last
        if self.psi in ("initial", "target"):
            return graph.stated_psi(self.psi, "export.psi")
        return psi_of_file(Path(self.psi).expanduser(), distribution, graph.names)

    def _workers(self, context: Context) -> Workers:
        on_cpu, of_run = context.graph.device.type == "cpu", context.experiment.run.workers
        if self.workers is None and on_cpu:
            return of_run if of_run == "ray" else len(os.sched_getaffinity(0))
        if self.workers is None:
            return 0
        if self.workers and not on_cpu:
            raise ValueError(f"export.workers: want 0 or null with trainer=gpu, got {self.workers}")
        return self.workers

    def _camera(self, context: Context) -> PinholeCamera:
        own = context.graph.camera
        size = (own.width, own.height) if self.width is None else (self.width, cast(int, self.height))
        return reframed(own, *size)

    def _settings(self, context: Context) -> dict[str, Any]:
        """Return the data set's identity without the parts ``MADE``."""
        x = context.experiment
        described = {
            "renderer": describe(x.imaging.renderer),
            "synthesis": describe(x.imaging.synthesis),
        }
        return {
            "seed": x.run.seed,
            "classes": list(context.graph.names),
            "camera": opencv_entry(self._camera(context)),
            "distribution": describe(x.imaging.distribution.drawn),
            **({"empty_fraction": self.empty_fraction} if self.empty_fraction else {}),
            **described,
            "image_format": self.image_format,
            "bop": {"scene_size": self.scene_size} if "bop" in self.formats else None,
            "code": code_version([ImageSource.__module__, *modules_of(described)]),
        }


def _lock_of(root: Path) -> Path:
    """Return the path to pass to ``locked``, which replaces its suffix, for a data set."""
    return root.with_name(f".{root.name}.folder")


def _move_unfinished(left: Path, data: DataSet) -> bool:
    """Move an unfinished data set to this run's folder unless another run is working on it; return whether it moved."""
    if not (left / MANIFEST).is_file():
        return False
    try:
        with locked(_lock_of(left), wait=False, key="export.folder") as ours:
            if not ours or not left.exists():  # another run is working on it, or has moved it meanwhile
                return False
            ExportFolder(left, data.identity).check()
            shutil.move(left, data.root)
    except (OSError, ValueError) as error:
        _log.warning("export: starts again; %s is left as it is (%s)", left, error)
        return False
    _log.info("export: continues the unfinished data set moved from %s", left)
    return True


def _rounded_probabilities(
    distribution: SceneDistribution, psi: Float[Tensor, "objects K"], names: Sequence[str]
) -> dict[str, dict[str, list[float]]]:
    """Return the probabilities of every object by factor, rounded to 12 digits."""
    p = distribution.probabilities(psi.double())
    return {
        name: {factor: [round(v, 12) for v in p[factor][label].tolist()] for factor in p}
        for label, name in enumerate(names)
    }


def models_of(objects: Objects) -> list[Model]:
    """Return the objects in millimetres, in the frames of their meshes or, if photographed, in their normalised frame.

    If the size of any object is unknown, all radii are taken to be 100 mm, with a warning.
    """
    radii, made = objects.radii, []
    unknown = [name for name, radius in radii.items() if radius is None]
    if unknown:
        _log.warning(
            "export: the size of %s is unknown; the radius of every object counts as %g mm in poses and depth",
            ", ".join(unknown), UNKNOWN_RADIUS,
        )  # fmt: skip
    for name in objects.names:
        radius = radii[name]
        millimetres = UNKNOWN_RADIUS if unknown or radius is None else 1000.0 * radius
        if isinstance(own := objects.part(name), Meshes):
            item = own.items[name]
            to_model = np.diag([millimetres / item.radius] * 3 + [1.0]) @ item.transform
            made.append(Model(name, millimetres, to_model, item.mesh.copy().apply_transform(to_model)))
        else:
            made.append(Model(name, millimetres, np.diag([millimetres] * 3 + [1.0])))
    return made


def farthest(source: ImageSource) -> float:
    """Return an upper bound of all depths, in millimetres."""
    scene, distribution = source.scene, source.scene.distribution
    factor = next((f for f in distribution.binned if f.coordinate == "distance"), None)
    reach = distribution.ranges["distance"][1] if factor is None else factor.high
    reaches = [subject.field.reach for subject in scene.fields]
    each = zip(scene.radii, source.millimetres, reaches, strict=True)
    return max((reach / radius + own) * millimetres for radius, millimetres, own in each)


def _psi_identity(data: DataSet) -> dict[str, Any]:
    return {key: data.identity[key] for key in ("classes", "psi", "distribution")}

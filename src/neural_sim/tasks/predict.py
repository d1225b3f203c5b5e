"""Task ``predict``: run a saved detector on photographs, without objects, fields or a target set."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from torch import Tensor
from typing_extensions import override

from neural_sim.commandline import PATHS
from neural_sim.detector.metrics import evaluate, worthless
from neural_sim.detector.saved_detector import DOCUMENT, SavedDetector, detect
from neural_sim.devices import device_of
from neural_sim.documents import write_json
from neural_sim.pictures import check_headers
from neural_sim.ranges import Fraction, Matching, PositiveInt, validated
from neural_sim.report.detections import draw, result_rows, save_picture, scores_table
from neural_sim.target.photographs import PhotoFiles
from neural_sim.target.truth import Truth, without_pixels
from neural_sim.tasks.context import Context, Task

_log = logging.getLogger(__name__)


@validated
@dataclass(frozen=True)
class PredictTask(Task):
    """Detections on photographs of any size, drawn and in COCO format, and their scores if there are annotations.

    Args:
        images: a picture, a folder or a pattern (glob).
        model: a run's folder, or its ``model.safetensors``; None: this run's own, written by its report.
        annotations: a COCO file with ground truth; None: no scores. Pictures and classes that it lacks are left out of
            the results; the pictures are drawn all the same.
        categories: category names of that file -> class names, null to leave a category out. Categories not listed
            are classes of the same name.
        draw_above: smallest score of a box that is drawn. The results also contain the detections below it.
        batch_size: pictures per batch.

    Raises:
        ValueError: there are no pictures, or the header of a file is not that of a picture.
    """

    images: Annotated[str, Matching(bool, PATHS["predict.images"])]
    model: str | None = None
    annotations: str | None = None
    categories: Mapping[str, str | None] | None = None
    draw_above: Fraction = 0.3
    batch_size: PositiveInt = 16

    def __post_init__(self) -> None:
        check_headers(PhotoFiles(self.images, "predict.images").paths, "predict.images")

    @override
    def run(self, context: Context) -> None:
        folder, photos = context.folder, PhotoFiles(self.images, "predict.images")
        saved = self._saved(context).to(device_of(context.config["trainer"]["accelerator"]))
        truth = self._truth(saved, photos)
        category_ids = truth.category_ids if truth else {i: i + 1 for i in range(len(saved.class_names))}
        entries: list[dict[str, Any]] = []
        rows: list[dict[str, Any]] = []
        scored: list[tuple[dict[str, Tensor], tuple[Tensor, Tensor]]] = []
        starts = range(0, len(photos.paths), self.batch_size)
        for start in context.shown(starts, "predict"):
            paths = photos.paths[start : start + self.batch_size]
            pictures = [photos.read(path) for path in paths]
            for path, picture, found in zip(paths, pictures, detect(saved, pictures), strict=True):
                known = truth.boxes(path) if truth and path in truth.entries else None
                drawn = draw(picture, found, saved.class_names, self.draw_above, known[0] if known else None)
                save_picture(drawn, folder / "pictures", photos.name(path))
                if truth is None or known is not None:
                    entry = _entry(path, photos, truth, len(entries) + 1) | {
                        "width": picture.width, "height": picture.height,
                    }  # fmt: skip
                    entries.append(entry)
                    rows += result_rows(found, entry["id"], category_ids)
                if known is not None:
                    scored.append((found, known))
        categories = [{"id": id, "name": saved.class_names[label]} for label, id in category_ids.items()]
        write_json(folder / "coco_images.json", {"images": entries, "categories": categories}, indent=None)
        write_json(folder / "coco_results.json", rows, indent=None)
        if scored:
            ap = evaluate(
                [found for found, _ in scored], without_pixels([t for _, t in scored]), saved.class_names,
                saved.detector.score,
            )  # fmt: skip
            document = {"images": len(scored), **dataclasses.asdict(ap)}
            write_json(folder / "scores.json", document, indent=None)
            print(scores_table(ap, len(scored)))
            if (why := worthless(ap, [found for found, _ in scored])) is not None:
                _log.warning("predict: the score says nothing: %s", why)
        drawn = sum(row["score"] >= self.draw_above for row in rows)
        print(f"{len(rows)} detections in {len(entries)} pictures, {drawn} drawn\nresults: {folder}")

    def _saved(self, context: Context) -> SavedDetector:
        folder, kind = context.folder, context.config["detector"]["_target_"]
        if self.model is None and not (folder / DOCUMENT).is_file():
            raise ValueError("predict.model: want a run's folder or its model.safetensors, got null")
        try:
            return SavedDetector.load(folder if self.model is None else Path(self.model).expanduser(), kind)
        except ValueError as error:
            raise ValueError(f"predict.model: {error}") from error

    def _truth(self, saved: SavedDetector, photos: PhotoFiles) -> Truth | None:
        if self.annotations is None:
            return None
        return Truth(Path(self.annotations).expanduser(), self.categories, saved.class_names, photos)


def _entry(path: Path, photos: PhotoFiles, truth: Truth | None, number: int) -> dict[str, Any]:
    """Return the COCO entry of an image: the one in the annotations, or a new one."""
    if truth is None:
        return {"id": number, "file_name": photos.name(path)}
    return {key: truth.entries[path][key] for key in ("id", "file_name")}

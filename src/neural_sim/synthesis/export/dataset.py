"""A data set of drawn images: first every image with all its files, then the annotations of all in each format."""

from __future__ import annotations

import hashlib
import io
import logging
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import torch
from PIL import Image

from neural_sim.processes import Work, WorkersLost
from neural_sim.synthesis.export import bop
from neural_sim.synthesis.export.coco import COCO, coco_document
from neural_sim.synthesis.export.folder import ExportFolder, opencv_entry, record_of, write_json, write_whole
from neural_sim.synthesis.export.images import GOLDEN, ImageSource, spread
from neural_sim.synthesis.export.yolo import DATA, SEGMENT, write_yolo
from neural_sim.workers import Workers, workers

_log = logging.getLogger(__name__)

Format = Literal["coco", "yolo", "bop"]
ImageFormat = Literal["jpg", "png"]
FORMATS: tuple[Format, ...] = get_args(Format)


@dataclass(frozen=True)
class ImageWriter:
    """Writes an image and all files that belong to it, the image itself last, and returns its record.

    ``scene_size`` and ``scale`` are those of BOP; ``scene_size`` is None if BOP is not requested.
    """

    source: ImageSource
    root: Path
    image_format: ImageFormat
    scene_size: int | None
    scale: float

    def __call__(self, number: int) -> dict[str, Any]:
        """Write the image with this number."""
        image = self.source.image(number)
        if self.scene_size is not None:
            files = bop.image_files(image, number, self.scene_size, self.scale)
            for path, content in files.items():
                write_whole(self.root / path, content)
        file, stream = f"images/{number:06d}.{self.image_format}", io.BytesIO()
        # Fine edges keep their colour only without chroma subsampling.
        options = {"quality": 95, "subsampling": 0} if self.image_format == "jpg" else {"compress_level": 1}
        Image.fromarray(image.pixels).save(stream, "JPEG" if self.image_format == "jpg" else "PNG", **options)
        write_whole(self.root / file, stream.getvalue())
        digest = hashlib.sha256(stream.getvalue()).hexdigest()
        return record_of(image, self.source.camera, number, file, digest)


@dataclass(frozen=True)
class DataSet:
    """``count`` images from ``source`` in ``root``, in ``formats``.

    Existing images stay in the set, with their ids, even those numbered ``count`` or more. ``identity`` is what all
    images depend on, see ``ExportFolder``; ``models`` are the objects as BOP describes them, and depths reach up to
    ``farthest`` millimetres. ``val_fraction`` of the images are for validation; an image stays in its part when the set
    grows. Formats that an earlier export wrote are kept up to date. For ``workers`` see ``each``.
    """

    source: ImageSource
    root: Path
    models: Sequence[bop.Model]
    identity: Mapping[str, Any]
    count: int
    formats: Sequence[Format]
    image_format: ImageFormat = "jpg"
    scene_size: int = 1000
    farthest: float = 6553.5
    workers: Workers = 0
    val_fraction: float = 0.0

    def write(self, shown: Callable[[Iterable[int]], Iterable[int]]) -> list[dict[str, Any]]:
        """Write all missing images, then the annotations; return the records of all. ``shown`` is a progress bar.

        Raises:
            ValueError: the folder has images of another identity, or cannot be written.
        """
        folder, with_bop = ExportFolder(self.root, self.identity), "bop" in self.formats
        scale = bop.depth_scale(self.farthest)
        writer = ImageWriter(
            self.source, self.root.resolve(), self.image_format, self.scene_size if with_bop else None, scale
        )
        with folder.opened() as records:
            missing = [number for number in range(self.count) if number not in records]
            if records:
                _log.info("export: %s has %d images, %d to go", self.root, len(records), len(missing))
            begun, made = time.perf_counter(), each(writer, missing, self.workers, self.root)
            try:
                for number in shown(missing):
                    records[number] = next(made)
                    folder.add(records[number])
            finally:
                made.close()
            spent = time.perf_counter() - begun
            if missing:
                _log.info("export: %d images, %.2f a second", len(missing), len(missing) / spent)
            ordered = [records[number] for number in sorted(records)]
            self._annotate(ordered, scale)
            folder.finish(ordered)
        return ordered

    def parts(self, records: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
        """Return the records for training and for validation, or nothing if either would be empty."""
        parts: dict[str, list[Mapping[str, Any]]] = {"train": [], "val": []}
        for record in records:
            held_out = spread(record["number"], self.val_fraction, GOLDEN)
            parts["val" if held_out else "train"].append(record)
        return parts if all(parts.values()) else {}

    def _annotate(self, records: Sequence[Mapping[str, Any]], scale: float) -> None:
        names, parts = self.source.scene.names, self.parts(records)
        if self.val_fraction and not parts:
            _log.warning("export: %d images are too few for a split: none is made", len(records))
        for name in ("train", "val"):  # an earlier export may have made another split
            for path in (f"annotations_{name}.json", f"{name}.txt", f"{SEGMENT}/{name}.txt"):
                (self.root / path).unlink(missing_ok=True)
        # Files of an earlier export would lack the new images. BOP's cannot: the folder's identity says if it has them.
        if "coco" in self.formats or (self.root / COCO).exists():
            varies = any(
                factor.coordinate == "magnification" for factor in self.source.scene.distribution.binned
            )
            camera = None if varies else opencv_entry(self.source.camera)
            documents = {COCO: records} | {f"annotations_{name}.json": own for name, own in parts.items()}
            for name, own in documents.items():
                write_json(self.root / name, coco_document(own, names, camera))
        if "yolo" in self.formats or (self.root / DATA).exists():
            write_yolo(self.root, records, names, parts)
        if "bop" in self.formats:
            bop.write_bop(self.root, records, self.models, self.scene_size, scale)


T = TypeVar("T")


def each(
    task: Callable[[int], T], numbers: Sequence[int], by: Workers, folder: Path
) -> Generator[T, None, None]:
    """Yield the results of ``task`` for each number, in order.

    Every worker computes with one torch thread, so that results do not depend on the number of workers. ``by`` is the
    number of processes (0: this process alone) or a cluster. Each worker receives the task once, pickled; all must see
    ``folder``, to which it writes.

    Raises:
        WorkersLost: workers were killed, or could not start.
    """
    if by == 0:
        yield from _here(task, numbers)
        return
    try:
        with workers(by, len(numbers), Work(task, folder, threads=1)) as submit:
            for made in [submit(number) for number in numbers]:
                yield made.result()
    except WorkersLost as lost:
        raise WorkersLost(f"export: {lost}; the same command continues after the images that exist") from lost


def _here(task: Callable[[int], T], numbers: Sequence[int]) -> Generator[T, None, None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for number in numbers:
            yield task(number)
    finally:
        torch.set_num_threads(threads)

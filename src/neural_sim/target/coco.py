"""A user's own target set in COCO form."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from neural_sim.objects.mesh import ObjectMesh
from neural_sim.parameter.product import SceneDistribution
from neural_sim.renderer.base import MeshRenderer
from neural_sim.renderer.rig import LightRig
from neural_sim.synthesis.training_set import Synthesizer
from neural_sim.target.letterbox import letterbox
from neural_sim.target.split import split
from neural_sim.types import LabelledImages, PinholeCamera

_log = logging.getLogger(__name__)

REQUIRED: dict[str, tuple[str, ...]] = {
    "images": ("id", "file_name"),
    "categories": ("id", "name"),
    "annotations": ("image_id", "category_id", "bbox"),
}


@dataclass(frozen=True)
class CocoTarget:
    """Photographs with a COCO ``annotations`` file, letterboxed to the detector's image size.

    Args:
        annotations: the JSON file.
        images: the folder its ``file_name`` entries start from; None: the file's own.
        categories: category name -> object name, null to leave a category out. Names not listed stand for
            themselves.
        val_fraction: share of the images that steers psi; the rest is scored once.
        limit: at most so many images, the first by id.
        minimum_side: boxes with a side shorter than this many pixels after resizing are dropped and counted.

    Raises:
        ValueError: no such file, or a number out of its range.
    """

    annotations: str | Path
    images: str | Path | None = None
    categories: Mapping[str, str | None] | None = None
    val_fraction: float = 0.3
    limit: int | None = None
    minimum_side: float = 2.0

    def __post_init__(self) -> None:
        if not self._file.is_file():
            raise ValueError(f"target.annotations: no such file: {self._file}")
        if not 0.0 < self.val_fraction < 1.0:
            raise ValueError(f"target.val_fraction must lie in (0, 1), got {self.val_fraction}")
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"target.limit must be at least 1 or null, got {self.limit}")

    @property
    def _file(self) -> Path:
        return Path(self.annotations).expanduser()

    @property
    def _folder(self) -> Path:
        return self._file.parent if self.images is None else Path(self.images).expanduser()

    def digest(self) -> str:
        """SHA-256 of the annotations and of the photographs' sizes in bytes, for store keys."""
        state = hashlib.sha256(self._file.read_bytes())
        for entry in _read(self._file)["images"]:
            path = self._folder / entry["file_name"]
            state.update(f"{entry['file_name']} {path.stat().st_size if path.is_file() else None}\n".encode())
        return state.hexdigest()

    def sets(
        self,
        meshes: Mapping[str, ObjectMesh],
        renderer: MeshRenderer,
        distribution: SceneDistribution,
        camera: PinholeCamera,
        synthesizer: Synthesizer,
        seed: int,
        rig: LightRig | None = None,
    ) -> dict[str, LabelledImages]:
        """``val`` and ``test`` with the objects' names as classes; takes the arguments of every target set."""
        generator = torch.Generator().manual_seed(seed)
        val, test = split(self.load(list(meshes), camera.height, camera.width), self.val_fraction, generator)
        return {"val": val, "test": test}

    def load(self, class_names: Sequence[str], height: int, width: int) -> LabelledImages:
        """All images; labels are positions in ``class_names``. Crowd annotations are left out, boxes clipped.

        Raises:
            ValueError: malformed JSON, a category that is no class, an image that is missing or unreadable.
        """
        data = _read(self._file)
        labels = self._labels(data["categories"], class_names)
        entries = sorted(data["images"], key=lambda entry: entry["id"])[: self.limit]
        if not entries:
            raise ValueError(f"{self._file}: holds no images")
        by_image: dict[Any, list[dict[str, Any]]] = {entry["id"]: [] for entry in entries}
        for item in data["annotations"]:
            if not item.get("iscrowd", 0) and item["image_id"] in by_image:
                by_image[item["image_id"]].append(item)
        loaded = [self._image(e, by_image[e["id"]], labels, height, width) for e in entries]
        dropped = sum(count for _, _, _, count in loaded)
        if dropped:
            _log.warning("%s: %d boxes shorter than %g px dropped", self._file, dropped, self.minimum_side)
        return _assemble([(image, boxes, label) for image, boxes, label, _ in loaded])

    def _labels(self, categories: list[dict[str, Any]], class_names: Sequence[str]) -> dict[Any, int | None]:
        """Category id -> class index, None for a category left out."""
        mapping = dict(self.categories or {})
        named = {entry["id"]: mapping.get(entry["name"], entry["name"]) for entry in categories}
        strange = sorted({name for name in named.values() if name is not None and name not in class_names})
        absent = sorted(set(mapping) - {entry["name"] for entry in categories})
        if strange or absent:
            raise ValueError(
                f"{self._file}: categories {strange or absent} are "
                f"{'no objects' if strange else 'not in the file'}; objects are {list(class_names)}, the file's "
                f"categories {[entry['name'] for entry in categories]}. Map them by target.categories, "
                "{name: object} or {name: null} to leave one out"
            )
        for name in set(class_names) - set(named.values()):
            _log.warning("%s: no category for object %s, which gets no score", self._file, name)
        return {key: None if name is None else list(class_names).index(name) for key, name in named.items()}

    def _image(
        self,
        entry: dict[str, Any],
        annotations: list[dict[str, Any]],
        labels: dict[Any, int | None],
        height: int,
        width: int,
    ) -> tuple[Tensor, Tensor, Tensor, int]:
        """Image, boxes [b, 4], labels [b] and the number of boxes dropped."""
        path = self._folder / entry["file_name"]
        try:
            with Image.open(path) as photo:
                image, placing = letterbox(photo, height, width)
        except (OSError, UnidentifiedImageError) as error:
            raise ValueError(f"{path} (named in {self._file}): not a readable image ({error})") from error
        unknown = {item["category_id"] for item in annotations} - set(labels)
        if unknown:
            raise ValueError(f"{self._file}: category ids {sorted(unknown)} of {path.name} are not declared")
        kept = [item for item in annotations if labels[item["category_id"]] is not None]
        corners = torch.tensor([item["bbox"] for item in kept], dtype=torch.float32).reshape(-1, 4)
        corners[:, 2:] += corners[:, :2]
        boxes = placing.boxes(corners)
        large = ((boxes[:, 2:] - boxes[:, :2]) >= self.minimum_side).all(-1)
        classes = torch.tensor([labels[item["category_id"]] for item in kept], dtype=torch.long)
        return image, boxes[large], classes[large], int((~large).sum())


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    for section, keys in REQUIRED.items():
        entries = data.get(section) if isinstance(data, dict) else None
        if not isinstance(entries, list):
            raise ValueError(f"{path}: want a list {section!r}, as COCO has it")
        for number, entry in enumerate(entries):
            missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
            if missing:
                raise ValueError(f"{path}: {section}[{number}] lacks {missing}")
            if section == "annotations" and len(entry["bbox"]) != 4:
                raise ValueError(f"{path}: annotations[{number}].bbox must be x, y, width, height")
    return data


def _assemble(loaded: list[tuple[Tensor, Tensor, Tensor]]) -> LabelledImages:
    most = max(1, *(len(boxes) for _, boxes, _ in loaded))
    boxes = torch.zeros(len(loaded), most, 4)
    labels = torch.full((len(loaded), most), -1)
    for row, (_, box, label) in enumerate(loaded):
        boxes[row, : len(box)], labels[row, : len(box)] = box, label
    images = torch.stack([image for image, _, _ in loaded])
    return LabelledImages(images, boxes, labels, torch.full((len(loaded),), -1))

"""A trained detector as two files: ``model.safetensors``, its parameters, and ``model.json``, all else that it needs to
be built again and used: its class and settings, class names, image size, normalisation, camera.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.rebuild import described, rebuilt
from neural_sim.devices import placed
from neural_sim.documents import read_json
from neural_sim.types import PinholeCamera

FORMAT, VERSION = "neural-sim detector", 1
WEIGHTS, DOCUMENT = "model.safetensors", "model.json"
KEYS = ("format", "version", "weights", "class_names", "image", "detector", "camera")


@dataclass(frozen=True)
class SavedDetector:
    """A detector with its parameters.

    ``make`` is its constructor as ``conf/detector`` makes it, still without classes and image size; ``class_names`` are
    in the order of labels, ``image_size`` is (height, width) in pixels; ``camera`` is that of the images that it was
    trained on, where it is known.
    """

    make: Callable[..., Detector]
    params: Parameters
    class_names: tuple[str, ...]
    image_size: tuple[int, int]
    camera: PinholeCamera | None = None

    @cached_property
    def detector(self) -> Detector:
        return self.make(num_classes=len(self.class_names), image_size=self.image_size)

    def to(self, device: torch.device) -> SavedDetector:
        """The same with its parameters on ``device``."""
        return dataclasses.replace(self, params=placed(self.params, device))

    def save(self, folder: Path) -> Path:
        """Write both files, ``model.json`` last, and return the path of the parameters.

        Raises:
            ValueError: settings that JSON does not have, see :func:`rebuild.described`.
        """
        document = {
            "format": FORMAT,
            "version": VERSION,
            "class_names": list(self.class_names),
            "image": {
                "height": self.image_size[0], "width": self.image_size[1], "channels": "RGB", "range": [0.0, 1.0],
                "normalisation": _normalisation(self.detector),
            },
            "detector": described(self.make),
            "camera": None if self.camera is None else dataclasses.asdict(self.camera),
        }  # fmt: skip
        folder.mkdir(parents=True, exist_ok=True)
        path, draft = folder / WEIGHTS, folder / f".{WEIGHTS}.part"
        save_file({name: value.detach().cpu().contiguous() for name, value in self.params.items()}, draft)
        os.replace(draft, path)
        document["weights"] = {"file": WEIGHTS, "sha256": _sha256(path)}
        draft = folder / f".{DOCUMENT}.part"
        draft.write_text(json.dumps(document, indent=1, allow_nan=False), encoding="utf-8")
        os.replace(draft, folder / DOCUMENT)
        return path

    @staticmethod
    def load(path: Path) -> SavedDetector:
        """Read both files; ``path`` is their folder or one of them.

        Raises:
            ValueError: files that are missing, unreadable, of another format or version, that do not belong together,
                or whose parameters do not fit the detector; with the file, the key and what is wanted.
        """
        folder = path if path.is_dir() else path.parent
        named = path.is_file() and path.name in (WEIGHTS, DOCUMENT)
        if not (path.is_dir() or named):
            raise ValueError(f"want a run's folder, its {WEIGHTS} or {DOCUMENT}, got {path}" +
                             ("" if path.exists() else ", which does not exist"))  # fmt: skip
        for name in (DOCUMENT, WEIGHTS):
            if not (folder / name).is_file():
                raise ValueError(
                    f"{folder} has no {name}; a run writes it with stages=[..., evaluate, report]"
                )
        document, file = _document(folder / DOCUMENT), folder / DOCUMENT
        names, size, camera = (
            _class_names(document, file),
            _image_size(document, file),
            _camera(document, file),
        )
        make = rebuilt(_mapping(document, "detector", file), file)
        params = _params(folder / WEIGHTS, _mapping(document, "weights", file), file)
        saved = SavedDetector(make, params, names, size, camera)
        try:
            detector = saved.detector
        except (ValueError, TypeError) as error:
            raise ValueError(f"{file}: {error}") from error
        _check_normalisation(document["image"].get("normalisation"), detector, file)
        _check_params(params, detector, folder / WEIGHTS)
        return saved


def _document(path: Path) -> dict[str, Any]:
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ValueError(f"{path}: format: want {FORMAT!r}, as a run's report writes it")
    if document.get("version") != VERSION:
        raise ValueError(f"{path}: version: want {VERSION}, got {document.get('version')!r}")
    missing = [key for key in KEYS if key not in document]
    if missing:
        raise ValueError(f"{path}: lacks {missing}, want {list(KEYS)}")
    return document


def _mapping(document: Mapping[str, Any], key: str, file: Path) -> Mapping[str, Any]:
    if not isinstance(document[key], Mapping):
        raise ValueError(f"{file}: {key}: want a mapping, got {document[key]!r}")
    return document[key]


def _class_names(document: Mapping[str, Any], file: Path) -> tuple[str, ...]:
    names = document["class_names"]
    strings = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not strings or not names or len(set(names)) < len(names):
        raise ValueError(f"{file}: class_names: want a list of different names, got {names!r}")
    return tuple(names)


def _image_size(document: Mapping[str, Any], file: Path) -> tuple[int, int]:
    image = _mapping(document, "image", file)
    for key in ("height", "width"):
        if type(image.get(key)) is not int or image[key] < 1:
            raise ValueError(f"{file}: image.{key}: want a whole number from 1, got {image.get(key)!r}")
    for key, wanted in (("channels", "RGB"), ("range", [0.0, 1.0])):
        if image.get(key) != wanted:
            raise ValueError(f"{file}: image.{key}: want {wanted!r}, got {image.get(key)!r}")
    return image["height"], image["width"]


def _camera(document: Mapping[str, Any], file: Path) -> PinholeCamera | None:
    if document["camera"] is None:
        return None
    entry = dict(_mapping(document, "camera", file))
    try:
        entry["centre"] = None if entry.get("centre") is None else tuple(entry["centre"])
        return PinholeCamera(**entry)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: camera: {error}") from error


def _params(path: Path, weights: Mapping[str, Any], file: Path) -> Parameters:
    if weights.get("sha256") != _sha256(path):
        raise ValueError(f"{path}: is not the file that {file} describes (weights.sha256 differs)")
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not readable as safetensors ({error})") from error


def _normalisation(detector: Detector) -> dict[str, list[float]] | None:
    """What the detector does to images in [0, 1], where it says so."""
    stored = getattr(detector, "normalisation", None)
    return None if stored is None else {key: list(values) for key, values in stored.items()}


def _check_normalisation(stored: Any, detector: Detector, file: Path) -> None:
    wanted = _normalisation(detector)
    if stored != wanted:
        raise ValueError(
            f"{file}: image.normalisation: want {wanted}, as this version's detector has it, got {stored}"
        )


def _check_params(params: Parameters, detector: Detector, path: Path) -> None:
    shapes = getattr(detector, "shapes", None)
    if shapes is None:  # of a detector from outside the package
        shapes = {name: tuple(value.shape) for name, value in detector.init(torch.Generator()).items()}
    for name, shape in shapes.items():
        if name not in params:
            raise ValueError(f"{path}: lacks {name}, which the detector has")
        if tuple(params[name].shape) != shape:
            raise ValueError(f"{path}: {name}: want shape {list(shape)}, got {list(params[name].shape)}")
        if not bool(params[name].isfinite().all()):
            raise ValueError(f"{path}: {name}: want finite values")
    strange = sorted(set(params) - set(shapes))
    if strange:
        raise ValueError(f"{path}: has {strange[0]}, which the detector has not")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

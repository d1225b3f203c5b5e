"""Save and load a trained detector as two files, and detect objects in photographs with it.

``model.safetensors`` holds its parameters, ``model.json`` everything else that is needed to build and use it: its class
and settings, class names, image size, normalisation, camera.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import inspect
import json
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from neural_sim.detector.protocol import Detector, Parameters
from neural_sim.detector.settings import SAVED, Backbone
from neural_sim.devices import placed
from neural_sim.documents import read_json, write_whole
from neural_sim.target.photographs import letterbox
from neural_sim.types import PinholeCamera

SHAPE = ("num_classes", "image_size")
"""Arguments that every detector has; a file stores them apart from its settings."""
FORMAT, VERSION = "neural-sim detector", 1
WEIGHTS, DOCUMENT = "model.safetensors", "model.json"
KEYS = ("format", "version", "weights", "class_names", "image", "detector", "camera")


@dataclass(frozen=True)
class SavedDetector:
    """A detector with its parameters.

    ``make`` is its constructor as configured in ``conf/detector``, which still takes the number of classes and the
    image size. ``class_names`` are in the order of labels, ``image_size`` is (height, width) in pixels, ``camera`` is
    the camera of the training images, if known.
    """

    make: Callable[..., Detector]
    params: Parameters
    class_names: tuple[str, ...]
    image_size: tuple[int, int]
    camera: PinholeCamera | None = None

    @cached_property
    def detector(self) -> Detector:
        """The detector, built with its classes and image size."""
        return self.make(num_classes=len(self.class_names), image_size=self.image_size)

    def to(self, device: torch.device) -> SavedDetector:
        """Return the detector with its parameters on ``device``."""
        return dataclasses.replace(self, params=placed(self.params, device))

    def save(self, folder: Path) -> Path:
        """Write both files, ``model.json`` last, and return the path of the parameters.

        Raises:
            ValueError: a setting cannot be written as JSON, see ``described``.
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
        weights = save({name: value.detach().cpu().contiguous() for name, value in self.params.items()})
        document["weights"] = {"file": WEIGHTS, "sha256": hashlib.sha256(weights).hexdigest()}
        text = json.dumps(document, indent=1, allow_nan=False)
        for name, content in ((WEIGHTS, weights), (DOCUMENT, text.encode())):
            write_whole(folder / name, content)
        return folder / WEIGHTS

    @staticmethod
    def load(path: Path, outside: str | None = None) -> SavedDetector:
        """Read both files.

        Args:
            path: the folder of both files, or one of them.
            outside: ``module.class`` of a detector outside this package that may be imported. Without it, such a class
                must have been imported already: a file alone imports nothing.

        Raises:
            ValueError: files are missing, unreadable, of another format or version, do not belong together, or have
                parameters that do not fit the detector. The message names the file, the key and what is wanted.
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
        make = rebuilt(_mapping(document, "detector", file), file, outside)
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
            raise ValueError(
                f"{file}: image.{key}: want a whole number of at least 1, got {image.get(key)!r}"
            )
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
    """Return the channel normalisation that the detector declares, or None."""
    stored = detector.normalisation
    return None if stored is None else {key: list(values) for key, values in stored.items()}


def _check_normalisation(stored: Any, detector: Detector, file: Path) -> None:
    wanted = _normalisation(detector)
    if stored != wanted:
        raise ValueError(
            f"{file}: image.normalisation: want {wanted}, as this version's detector has it, got {stored}"
        )


def _check_params(params: Parameters, detector: Detector, path: Path) -> None:
    shapes = getattr(detector, "shapes", None)
    if shapes is None:  # a detector from outside the package
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
        raise ValueError(f"{path}: has {strange[0]}, which the detector does not have")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def detect(saved: SavedDetector, photos: Sequence[Image.Image]) -> list[dict[str, Tensor]]:
    """Detect objects in photographs.

    Photographs are letterboxed like those of a target set. Detections that lie wholly in the grey border are left out.

    Returns:
        For each photograph, best first, on the CPU: boxes [d, 4] as (x0, y0, x1, y1) in its pixels and within it,
        scores [d], labels [d].
    """
    if not photos:
        return []
    images, placings = zip(*(letterbox(photo, *saved.image_size) for photo in photos), strict=True)
    found = saved.detector.predict(saved.params, torch.stack(images))
    detections = []
    for placing, image in zip(placings, found, strict=True):
        boxes = placing.of_photo(image["boxes"])
        inside = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        detections.append({name: value[inside] for name, value in {**image, "boxes": boxes}.items()})
    return detections


def described(make: Callable[..., Detector]) -> dict[str, Any]:
    """Describe a detector's constructor as configured in ``conf/detector``: a class, or a partial call of one.

    ``settings`` has all arguments except the number of classes and the image size. It includes defaults, because
    another version of the project may change them.

    Returns:
        The constructor's ``class`` and ``settings``.

    Raises:
        ValueError: an argument is not a number, string, sequence, mapping or dataclass of these.
    """
    kind, given = make, {}
    # functools.partial does not flatten Hydra's own partial, which is a subclass.
    while isinstance(kind, functools.partial):
        kind, given = kind.func, {**kind.keywords, **given}
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(kind).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    arguments = {name: value for name, value in {**defaults, **given}.items() if name not in SHAPE}
    settings = {name: _plain(value, f"detector.{name}") for name, value in arguments.items()}
    return {"class": f"{kind.__module__}:{kind.__qualname__}", "settings": settings}


def rebuilt(
    description: Mapping[str, Any], file: Path, outside: str | None = None
) -> Callable[..., Detector]:
    """Rebuild a constructor from the output of ``described``; its class must derive from ``Detector``.

    No code runs except that of the class's module, which is imported. For ``outside`` see ``SavedDetector.load``.

    Raises:
        ValueError: the class cannot be imported or is not a detector, or a setting is unknown or refused. The message
            names the file and the key.
    """
    kind = _detector_class(description.get("class"), f"{file}: detector.class", outside)
    where = f"{file}: detector.settings"
    settings = description.get("settings")
    if not isinstance(settings, Mapping):
        raise ValueError(f"{where}: want a mapping of the constructor's arguments, got {settings!r}")
    return functools.partial(kind, **_arguments(kind, settings, where))


def _plain(value: Any, where: str) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Backbone) and value.weights is not None:
        value = dataclasses.replace(value, weights=SAVED)  # the values are among the saved parameters
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: _plain(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(item, where) for item in value]
    raise ValueError(
        f"{where}: want a number, a string, a list or a dataclass of these for a model file, got {value!r}"
    )


def _detector_class(name: Any, where: str, outside: str | None) -> type:
    module, colon, qualified = name.partition(":") if isinstance(name, str) else ("", "", "")
    if not (module and colon and qualified):
        raise ValueError(f"{where}: want 'module:class', got {name!r}")
    ours, target = module.partition(".")[0] == __name__.partition(".")[0], f"{module}.{qualified}"
    if not ours and module not in sys.modules and target != outside:
        raise ValueError(
            f"{where}: {name} is not a detector of this package, and reading it runs code of {module}: if you trust "
            f"that, add detector._target_={target}"
        )
    try:
        found: Any = functools.reduce(getattr, qualified.split("."), importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where}: {name} cannot be imported ({error}); is it on PYTHONPATH?") from error
    if not isinstance(found, type) or not issubclass(found, Detector):
        raise ValueError(
            f"{where}: {name} is not a detector, want a class that derives from neural_sim.detector.protocol.Detector"
        )
    return found


def _arguments(make: type, given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Convert mappings in ``given`` to the dataclasses that the constructor's type hints name."""
    known = inspect.signature(make).parameters
    hints = typing.get_type_hints(make if dataclasses.is_dataclass(make) else make.__init__)
    made = {}
    for key, value in given.items():
        if key not in known or key in SHAPE:
            raise ValueError(
                f"{where}.{key}: unknown key, want one of {', '.join(k for k in known if k not in SHAPE)}"
            )
        hint = hints.get(key)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            made[key] = _made(hint, value, f"{where}.{key}")
        else:
            made[key] = value
    return made


def _made(kind: type, value: Any, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: want a mapping of {kind.__name__}'s arguments, got {value!r}")
    arguments = _arguments(kind, value, where)
    try:
        return kind(**arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error

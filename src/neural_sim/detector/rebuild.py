"""A detector's constructor and its arguments as JSON, and back."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neural_sim.detector.protocol import Detector
from neural_sim.detector.settings import SAVED, Backbone

SHAPE = ("num_classes", "image_size")
"""Arguments of every detector, which a file names apart from its settings."""


def described(make: Callable[..., Detector]) -> dict[str, Any]:
    """``class`` and ``settings`` of a detector's constructor, as ``conf/detector`` makes it: a class, or a partial call
    of one. All arguments but the classes and the image size are there, defaults too, which another version of the
    project may change.

    Raises:
        ValueError: an argument that is no number, string, sequence, mapping or dataclass of these.
    """
    kind, given = make, {}
    while isinstance(
        kind, functools.partial
    ):  # Hydra's own is a subclass, which a partial call of it stays around
        kind, given = kind.func, {**kind.keywords, **given}
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(kind).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    arguments = {name: value for name, value in {**defaults, **given}.items() if name not in SHAPE}
    settings = {name: _plain(value, f"detector.{name}") for name, value in arguments.items()}
    return {"class": f"{kind.__module__}:{kind.__qualname__}", "settings": settings}


def rebuilt(description: Mapping[str, Any], file: Path) -> Callable[..., Detector]:
    """Inverse of :func:`described`. Runs no code but the named class's own, which must derive from :class:`Detector`.

    Raises:
        ValueError: a class that cannot be imported or is no detector, a setting that it does not have or refuses;
            with the file and the key.
    """
    kind = _detector_class(description.get("class"), f"{file}: detector.class")
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
        value = dataclasses.replace(value, weights=SAVED)  # their values are among the saved parameters
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


def _detector_class(name: Any, where: str) -> type:
    module, colon, qualified = name.partition(":") if isinstance(name, str) else ("", "", "")
    if not (module and colon and qualified):
        raise ValueError(f"{where}: want 'module:class', got {name!r}")
    try:
        found: Any = functools.reduce(getattr, qualified.split("."), importlib.import_module(module))
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where}: {name} cannot be imported ({error}); is it on PYTHONPATH?") from error
    if not isinstance(found, type) or not issubclass(found, Detector):
        raise ValueError(
            f"{where}: {name} is no detector, want a class that derives from neural_sim.detector.protocol.Detector"
        )
    return found


def _arguments(make: type, given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """``given`` with mappings made into the dataclasses that the constructor's hints name."""
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

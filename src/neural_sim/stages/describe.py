"""Describe settings as plain JSON, from which keys are computed, and find the modules whose code they run."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from neural_sim.digests import tensor_digest


def describe(value: Any) -> Any:
    """Return a JSON tree that is equal for equal settings.

    Takes scalars, sequences, mappings, tensors, paths, partial calls, classes and functions. Other objects are
    described by their class, their ``digest()`` if they have one (sources of files do), and their constructor
    arguments: the fields of a dataclass, or the attributes named like the arguments.

    Raises:
        TypeError: a value of any other kind; a key must not depend on the address of an object.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        return {str(key): describe(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [describe(item) for item in value]
    if isinstance(value, torch.Tensor):
        return {"tensor": tensor_digest([value])}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, functools.partial):
        return {"call": _name(value.func), "with": describe([*value.args, value.keywords])}
    if isinstance(value, type) or (callable(value) and hasattr(value, "__qualname__")):
        return {"call": _name(value)}
    described: dict[str, Any] = {"class": _name(type(value))}
    if callable(getattr(value, "digest", None)):
        described["digest"] = value.digest()
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
    else:
        names = _arguments(type(value))
        if not names or any(not hasattr(value, name) for name in names):
            if "digest" in described:
                return described
            raise TypeError(
                f"key: cannot describe {type(value).__qualname__}: its constructor arguments are not attributes"
            )
    return described | {name: describe(getattr(value, name)) for name in names}


def _arguments(kind: type) -> list[str]:
    """Return the argument names of a constructor; none if it has no signature."""
    try:
        return list(inspect.signature(kind).parameters)
    except ValueError:
        return []


def modules_of(description: Any) -> Iterator[str]:
    """Yield the modules of all classes and functions named in a description."""
    if isinstance(description, Mapping):
        for key, item in description.items():
            if key in ("class", "call") and isinstance(item, str):
                yield item.partition(":")[0]
            else:
                yield from modules_of(item)
    elif isinstance(description, Sequence) and not isinstance(description, str):
        for item in description:
            yield from modules_of(item)


def _name(thing: Callable[..., Any]) -> str:
    return f"{thing.__module__}:{thing.__qualname__}"

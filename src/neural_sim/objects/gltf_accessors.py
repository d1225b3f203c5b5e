"""The numbers in the buffers of a glTF file: scalars and vectors, with strides, normalised or sparse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST = 100_000_000
"""Largest plausible count; without a limit, a damaged count could ask for all memory."""


class Accessors:
    """Reads accessors by index.

    Args:
        document: the JSON of the file.
        buffers: the bytes of its buffers.
    """

    def __init__(self, document: Mapping[str, Any], buffers: Sequence[bytes]) -> None:
        self._accessors, self._views = document.get("accessors", []), document.get("bufferViews", [])
        self._buffers = buffers

    def view(self, index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self._views[index]
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise ValueError(
                "is compressed by EXT_meshopt_compression, which is not supported; export the file without it"
            )
        data, start = self._buffers[view["buffer"]], view.get("byteOffset", 0)
        end = start + view["byteLength"]
        if not 0 <= start <= end <= len(data):
            raise ValueError(
                f"bufferViews[{index}] wants bytes {start} to {end}, but its buffer has {len(data)}"
            )
        return data[start:end]

    def stored(self, index: int) -> bool:
        """Return whether the file stores an accessor's numbers itself, rather than compressed by an extension."""
        return "bufferView" in self._accessors[index] or "sparse" in self._accessors[index]

    def floats(self, index: int, width: int) -> Float[np.ndarray, "n width"]:
        """Return vectors; integers are scaled to [0, 1] or [-1, 1] if the file says so."""
        values = self._values(index)
        if values.shape[1] != width:
            raise ValueError(f"accessors[{index}]: want vectors of {width}, got {values.shape[1]}")
        if self._accessors[index].get("normalized", False):
            return _normalised(values)
        return values.astype(np.float64)

    def unit(self, index: int) -> Float[np.ndarray, "n width"]:
        """Return colours or texture coordinates; integers are fractions of their largest value."""
        values = self._values(index)
        if values.shape[1] < 2:
            raise ValueError(f"accessors[{index}]: want vectors of 2 to 4, got {values.shape[1]}")
        return _normalised(values)

    def integers(self, index: int) -> Int[np.ndarray, "n"]:
        """Return indices."""
        values = self._values(index)
        if values.shape[1] != 1 or values.dtype.kind == "f":
            raise ValueError(f"accessors[{index}]: want integer indices")
        return values[:, 0].astype(np.int64)

    def _values(self, index: int) -> Shaped[np.ndarray, "n width"]:
        accessor = self._accessors[index]
        dtype, width = (
            np.dtype(_TYPES[accessor["componentType"]]).newbyteorder("<"),
            _WIDTHS[accessor["type"]],
        )
        count = accessor["count"]
        if not (isinstance(count, int) and 0 <= count <= _MOST):
            raise ValueError(f"accessors[{index}].count: want 0 to {_MOST}, got {count!r}")
        if "bufferView" in accessor:
            start = accessor.get("byteOffset", 0)
            values = self._rows(accessor["bufferView"], start, count, width, dtype)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._sparse(values, accessor["sparse"], index)
        return values

    def _rows(
        self, view: int, start: int, count: int, width: int, dtype: np.dtype
    ) -> Shaped[np.ndarray, "n width"]:
        data = self.view(view)
        size = width * dtype.itemsize
        stride = self._views[view].get("byteStride", size)
        end = start + (count - 1) * stride + size if count else start
        if start < 0 or stride < size or end > len(data):
            raise ValueError(f"bufferViews[{view}] has {len(data)} bytes, but an accessor wants {end}")
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize)).copy()

    def _sparse(self, values: np.ndarray, sparse: Mapping[str, Any], index: int) -> np.ndarray:
        """Replace the numbers that a sparse accessor lists."""
        count, places, new = sparse["count"], sparse["indices"], sparse["values"]
        kind = np.dtype(_TYPES[places["componentType"]]).newbyteorder("<")
        at = self._rows(places["bufferView"], places.get("byteOffset", 0), count, 1, kind)[:, 0]
        if count and int(at.max()) >= len(values):
            raise ValueError(
                f"accessors[{index}].sparse replaces element {at.max()}, but there are {len(values)}"
            )
        values[at] = self._rows(
            new["bufferView"], new.get("byteOffset", 0), count, values.shape[1], values.dtype
        )
        return values


def _normalised(values: Shaped[np.ndarray, "n width"]) -> Float[np.ndarray, "n width"]:
    """Scale integers to fractions of their largest value."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)

"""Read the elements of a PLY file as stored: ASCII or binary, in either byte order, with lists of any length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Shaped

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
Order = Literal["<", ">"]
"""Byte order of a number: little- or big-endian."""
_END = b"end_header"
_MOST = 100_000_000


@dataclass(frozen=True)
class Property:
    """A property: its type, and the type of its lengths if it is a list."""

    name: str
    kind: np.dtype
    lengths: np.dtype | None = None


@dataclass
class Element:
    """An element's columns by name: an array for numbers, an array of arrays if lists differ in length."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    columns: dict[str, Shaped[np.ndarray, "n *each"]] = field(default_factory=dict)


def read_elements(path: Path) -> dict[str, Element]:
    """Read a PLY file's elements, by name.

    Raises:
        ValueError: the header or the data are not a PLY file's, or end too early.
    """
    data = path.read_bytes()
    head, found, body = data.partition(_END)
    if not data.startswith(b"ply") or not found:
        raise ValueError("has no PLY header")
    body = body.partition(b"\n")[2] if b"\n" in body[:3] else body.partition(b"\r")[2]
    lines = head.decode("utf-8", "replace").replace("\r", "\n").split("\n")
    encoding, elements = _declared(lines)
    if encoding == "ascii":
        _read_text(elements, body)
    else:
        _read_binary(elements, body, "<" if encoding == "binary_little_endian" else ">")
    return {element.name: element for element in elements}


def _declared(lines: Sequence[str]) -> tuple[str, list[Element]]:
    encoding, elements = "", []
    for line in lines:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                encoding = words[1]
            elif words[:1] == ["element"]:
                elements.append(Element(words[1], int(words[2])))
            elif words[:1] == ["property"] and words[1] == "list":
                kind, lengths = np.dtype(_TYPES[words[3]]), np.dtype(_TYPES[words[2]])
                elements[-1].properties.append(Property(words[4], kind, lengths))
            elif words[:1] == ["property"]:
                elements[-1].properties.append(Property(words[2], np.dtype(_TYPES[words[1]])))
        except (IndexError, KeyError, ValueError):
            raise ValueError(f"cannot read the header's line {line.strip()!r}") from None
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"want format ascii, binary_little_endian or binary_big_endian, got {encoding!r}")
    for element in elements:
        if not 0 <= element.count <= _MOST:
            raise ValueError(f"the header declares {element.count} rows of {element.name}, want 0 to {_MOST}")
    return encoding, elements


# --- binary ---


def _read_binary(elements: Sequence[Element], data: bytes, order: Order) -> None:
    start = 0
    for element in elements:
        start = _rows_of_bytes(element, data, start, order)


def _rows_of_bytes(element: Element, data: bytes, start: int, order: Order) -> int:
    """Read an element's columns and return where they end; rows whose lists are equally long are read at once."""
    lengths = _lengths_at(element, data, start, order)
    fields: list[tuple] = []
    for number, (item, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if item.lengths is not None:
            fields.append((f"length {number}", item.lengths.newbyteorder(order)))
            fields.append((f"value {number}", item.kind.newbyteorder(order), (length,)))
        else:
            fields.append((f"value {number}", item.kind.newbyteorder(order)))
    rows = np.dtype(fields)
    end = start + element.count * rows.itemsize
    uniform = end <= len(data)
    if uniform:
        table: Any = np.frombuffer(data, rows, element.count, start) if rows.itemsize else np.zeros(0)
        uniform = all(
            (table[f"length {number}"] == length).all()
            for number, (item, length) in enumerate(zip(element.properties, lengths, strict=True))
            if item.lengths is not None
        )
        if uniform:
            for number, item in enumerate(element.properties):
                element.columns[item.name] = table[f"value {number}"].astype(item.kind)
            return end
    if all(item.lengths is None for item in element.properties):
        raise ValueError(f"is cut off: want {element.count} rows of {element.name}, got fewer")
    return _row_by_row(element, data, start, order)


def _lengths_at(element: Element, data: bytes, start: int, order: Order) -> list[int]:
    """Return the lengths of the lists in the row at ``start``; 0 for numbers."""
    made = []
    for item in element.properties:
        length = 0
        if item.lengths is not None and element.count:
            length = int(_take(data, start, item.lengths, 1, order, element)[0])
            if length < 0:
                raise ValueError(f"a list of {element.name} has length {length}")
            start += item.lengths.itemsize
        start += item.kind.itemsize * (length if item.lengths is not None else 1)
        made.append(length)
    return made


def _row_by_row(element: Element, data: bytes, start: int, order: Order) -> int:
    columns: list[list[np.ndarray]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for column, item, length in zip(
            columns, element.properties, _lengths_at(element, data, start, order), strict=True
        ):
            count = 1
            if item.lengths is not None:
                start, count = start + item.lengths.itemsize, length
            column.append(_take(data, start, item.kind, count, order, element))
            start += count * item.kind.itemsize
    _keep(element, columns)
    return start


def _take(data: bytes, start: int, kind: np.dtype, count: int, order: Order, element: Element) -> np.ndarray:
    if start + count * kind.itemsize > len(data):
        raise ValueError(f"is cut off: want {element.count} rows of {element.name}, got fewer")
    return np.frombuffer(data, kind.newbyteorder(order), count, start).astype(kind)


# --- text ---


def _read_text(elements: Sequence[Element], data: bytes) -> None:
    words, start = data.split(), 0
    for element in elements:
        try:
            start = _rows_of_words(element, words, start)
        except IndexError:
            raise ValueError(f"is cut off: want {element.count} rows of {element.name}, got fewer") from None
    if start < len(words):
        raise ValueError(f"has {len(words) - start} more numbers than its header says")


def _rows_of_words(element: Element, words: Sequence[bytes], start: int) -> int:
    if all(item.lengths is None for item in element.properties):
        width = len(element.properties)
        end = start + width * element.count
        if end > len(words):
            raise IndexError
        table = np.array(words[start:end], dtype=np.float64).reshape(element.count, width)
        for number, item in enumerate(element.properties):
            element.columns[item.name] = _typed(table[:, number], item)
        return end
    columns: list[list[np.ndarray]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for column, item in zip(columns, element.properties, strict=True):
            count = 1
            if item.lengths is not None:
                count, start = int(words[start]), start + 1
            if count < 0:
                raise ValueError(f"a list of {element.name} has length {count}")
            if start + count > len(words):
                raise IndexError
            column.append(_typed(np.array(words[start : start + count], dtype=np.float64), item))
            start += count
    _keep(element, columns)
    return start


def _typed(values: Shaped[np.ndarray, "n"], item: Property) -> Shaped[np.ndarray, "n"]:
    """Convert numbers to a property's type if it is an integer, which must be able to hold them."""
    if item.kind.kind == "f":
        return values  # stays in double precision, to keep all digits of the text
    limits = np.iinfo(item.kind)
    if not ((values >= limits.min) & (values <= limits.max) & (values == np.rint(values))).all():
        raise ValueError(f"{item.name} has a value that its type {item.kind} cannot hold")
    return values.astype(item.kind)


def _keep(element: Element, columns: Sequence[Sequence[np.ndarray]]) -> None:
    for item, column in zip(element.properties, columns, strict=True):
        if item.lengths is None:
            element.columns[item.name] = np.concatenate(column) if column else np.zeros(0, item.kind)
        elif len({len(values) for values in column}) <= 1:
            element.columns[item.name] = np.stack(column) if column else np.zeros((0, 0), item.kind)
        else:
            ragged = np.empty(len(column), dtype=object)
            ragged[:] = column
            element.columns[item.name] = ragged

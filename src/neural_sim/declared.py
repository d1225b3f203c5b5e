"""Check settings against the types that classes declare, read from their source, because importing them takes seconds.

A declaration that needs other imports, such as that of a part with a class of its own, is left to
``ranges.validated``, which checks everything when a class is constructed.
"""

from __future__ import annotations

import ast
import collections.abc
import functools
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import annotated_types

from neural_sim import commandline, ranges

PACKAGE = Path(__file__).parent
_LIGHT = {
    module.__name__: vars(module)
    for module in (annotated_types, collections.abc, commandline, ranges, typing)
}
"""Modules that declarations may import from, with their names."""


def check_early(node: Any, where: str) -> None:
    """Check the values of a node of the configuration, and of those below it, as far as declarations can be read.

    Args:
        node: a mapping, checked by its ``_target_`` if it has one; anything else is not checked.
        where: the node's key.

    Raises:
        UserError: a value does not fit; the message has its key.
    """
    if not isinstance(node, Mapping):
        return
    target = node.get("_target_")
    types = declared(target) if isinstance(target, str) else {}
    for key, value in node.items():
        if isinstance(value, Mapping):
            check_early(value, f"{where}.{key}")
        elif key in types:
            ranges.check(value, types[key], f"{where}.{key}")
    ranges.check_together(node, types, where)


@functools.cache
def declared(target: str) -> Mapping[str, Any]:
    """Return the types of a class's own arguments by name, those that can be read; empty for a function."""
    package, *parts, name = target.split(".")
    path = PACKAGE.joinpath(*parts).with_suffix(".py")
    if package != PACKAGE.name or not path.is_file():
        return {}
    known: dict[str, Any] = {}
    for line in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ImportFrom) and line.module in _LIGHT:
            held = _LIGHT[line.module]
            known.update({alias.asname or alias.name: held[alias.name] for alias in line.names})
        elif isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            # perhaps a type's short name
            known.update(_read([(line.targets[0].id, line.value)], known))
        elif isinstance(line, ast.ClassDef) and line.name == name:
            return dict(_read(_arguments(line), known))
    return {}


def _arguments(made: ast.ClassDef) -> Iterator[tuple[str, ast.expr]]:
    for line in made.body:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            yield line.target.id, line.annotation
        elif isinstance(line, ast.FunctionDef) and line.name == "__init__":
            yield from ((each.arg, each.annotation) for each in line.args.args if each.annotation)


def _read(written: Any, known: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield what the expressions stand for, without those that have unknown names."""
    for name, expression in written:
        try:
            value = eval(ast.unparse(expression), dict(known))
        except (NameError, TypeError, AttributeError):
            continue
        if typing.get_origin(value) is not typing.ClassVar:
            yield name, value

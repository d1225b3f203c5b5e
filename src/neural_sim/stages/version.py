"""The version of the code that a result depends on: a digest of the source of modules and all that they import."""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT.name


def code_version(modules: Iterable[str], root: Path = ROOT) -> str:
    """Return a digest of the source of ``modules`` and of all modules of this package that they import, at any depth.

    Comments, layout and docstrings are left out, so that stored results survive edits of prose. A module outside the
    package counts by its own source, without its imports; modules in site-packages, and those without readable source,
    do not count.
    """
    total = hashlib.sha256()
    for name in sorted(closure(modules, root)):
        path = _source(name, root)
        if path is not None:
            total.update(name.encode() + _read(path, root).meaning)
    return total.hexdigest()[:12]


def closure(modules: Iterable[str], root: Path = ROOT) -> set[str]:
    """Return ``modules`` and all modules of the package under ``root`` that they import, directly or not."""
    names: set[str] = set()
    waiting = [name for name in modules if _source(name, root) is not None]
    while waiting:
        name = waiting.pop()
        if name in names:
            continue
        names.add(name)
        path = _source(name, root)
        if path is not None and path.is_relative_to(root):
            waiting += _read(path, root).imports
    return names


@dataclass(frozen=True)
class _File:
    """A digest of the normalised source of one file, and the modules of the package that it imports."""

    meaning: bytes
    imports: tuple[str, ...]


def _read(path: Path, root: Path) -> _File:
    state = path.stat()
    return _parsed(path, root, state.st_mtime_ns, state.st_size)


@cache
def _parsed(path: Path, root: Path, _modified: int, _size: int) -> _File:
    tree = ast.parse(path.read_text())
    imports = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # A name imported from a package may be a module or defined in its __init__.
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        imports |= {name for name in names if name.split(".")[0] == root.name and _source(name, root)}
    meaning = hashlib.sha256(_text(_without_docstrings(tree)).encode()).digest()
    return _File(meaning, tuple(sorted(imports)))


def _text(node: object) -> str:
    """Return a syntax tree as text that is the same in all versions of Python.

    Empty fields are left out, because newer versions add some (``type_params`` of every function in 3.12).
    """
    if isinstance(node, ast.AST):
        fields = [(name, value) for name, value in ast.iter_fields(node) if value is not None and value != []]
        return f"{type(node).__name__}({', '.join(f'{name}={_text(value)}' for name, value in fields)})"
    if isinstance(node, list):
        return f"[{', '.join(_text(each) for each in node)}]"
    return repr(node)


def _source(name: str, root: Path) -> Path | None:
    """Return the source file of a module; None in site-packages, for builtins and for names that are not modules."""
    first, *rest = name.split(".")
    if first == root.name:
        place = root.joinpath(*rest)
        candidates = (place / "__init__.py", place.with_suffix(".py"))
        return next((path for path in candidates if path.is_file()), None)
    module = sys.modules.get(name)
    try:
        path = inspect.getsourcefile(module) if module else None
    except TypeError:
        return None
    return Path(path) if path and "site-packages" not in path and Path(path).is_file() else None


def _without_docstrings(tree: ast.AST) -> ast.AST:
    """Drop every statement that is only a string: docstrings, including those below attributes and constants."""
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            body = getattr(node, name, None)
            if isinstance(body, list):
                setattr(node, name, [each for each in body if not _is_text(each)])
    return tree


def _is_text(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )

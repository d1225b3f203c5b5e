"""Reading and hashing of mesh files, shared by the loaders."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import trimesh
from annotated_types import MinLen

from neural_sim.objects.gltf import gltf_references, read_gltf
from neural_sim.objects.mesh import ObjectMesh, normalise
from neural_sim.objects.paint import join
from neural_sim.objects.ply import ply_references, read_ply
from neural_sim.objects.repair import repair
from neural_sim.objects.wavefront import obj_references, read_obj

Names = Annotated[list[str | int | float | bool | None], MinLen(1)] | None
"""Which objects of a folder to load; None: all. Values that are not text are names that the command
line parsed as numbers or YAML keywords."""
Y_UP_TO_Z_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def file_digest(*paths: Path) -> str:
    """Return the SHA-256 of the files' bytes, in the order given; missing files are skipped."""
    state = hashlib.sha256()
    for path in paths:
        if path.is_file():
            state.update(path.read_bytes())
    return state.hexdigest()


def content_digest(files: Mapping[str, Path]) -> str:
    """Return the SHA-256 of names and contents, independent of the files' folders; missing files count as empty."""
    lines = (f"{name} {file_digest(path)}\n" for name, path in files.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def load_file(path: Path, name: str, digest: str, metres_per_unit: float = 1.0) -> ObjectMesh:
    """Read, repair and normalise a mesh file; several parts are joined, each with its own material.

    glTF files, in which +y is up, are turned to +z up; others are not turned. The object's ``transform`` leads back to
    the file's own frame, in metres.

    Raises:
        ValueError: the file cannot be read or has no triangles; the message says why.
    """
    with _named(path, f"object {name!r} cannot be read as a mesh"):
        mesh = _READERS[path.suffix.lower()](path)
    mesh = repair(mesh, name, str(path))
    if metres_per_unit != 1.0:
        mesh.apply_scale(metres_per_unit)
    if path.suffix.lower() not in GLTF:
        return normalise(mesh, name, str(path), digest)
    mesh.apply_transform(Y_UP_TO_Z_UP)
    item = normalise(mesh, name, str(path), digest)
    return replace(item, transform=np.linalg.inv(Y_UP_TO_Z_UP) @ item.transform)


def references(path: Path) -> list[Path]:
    """Return the files that are read along with a mesh file: materials, textures, buffers.

    Raises:
        ValueError: a file is missing; the message names both files.
    """
    with _named(path, "cannot be read as a mesh"):
        return _REFERENCES.get(path.suffix.lower(), lambda _: [])(path)


@contextmanager
def _named(path: Path, what: str) -> Iterator[None]:
    """Turn anything that a reader raises on a damaged or unknown file into one line with the file's name."""
    try:
        yield
    except Exception as error:  # damaged files may raise anything
        reason = " ".join(str(error).split()) or "its content is damaged"
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ValueError(f"{path}: {what}: {kind}{reason}") from error


def _stl(path: Path) -> trimesh.Trimesh:
    mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh):
        raise ValueError(f"holds a {type(mesh).__name__}, want a triangle mesh")
    return mesh


GLTF = (".glb", ".gltf")
_READERS: dict[str, Callable[[Path], trimesh.Trimesh]] = {
    **dict.fromkeys(GLTF, lambda path: join(read_gltf(path))),
    ".obj": lambda path: join(read_obj(path)),
    ".ply": lambda path: join(read_ply(path)),
    ".stl": _stl,
}
_REFERENCES: dict[str, Callable[[Path], list[Path]]] = {
    **dict.fromkeys(GLTF, gltf_references),
    ".obj": obj_references,
    ".ply": ply_references,
}


def choose(
    available: dict[str, Path], names: Sequence[Any] | None, aliases: dict[str, str], where: str
) -> list[str]:
    """Return the objects that ``names`` lists, in that order, with aliases resolved; None lists all, sorted.

    A value that the command line parsed as a number or YAML keyword (1, 1e3, 2024_05_01, true, null) stands for the
    only name that can be read as this value.

    Raises:
        ValueError: a name is unknown, or an object is named twice.
    """
    if names is None:
        return sorted(available)
    chosen = []
    for name in names:
        text = name if isinstance(name, str) else _written(name, [*available, *aliases])
        key = text if text in available else aliases.get(text)
        if key is None:
            hint = "" if isinstance(name, str) else f"; quote it: \"objects.names=['{name}']\""
            raise ValueError(
                f"objects.names: {name!r} is not in {where}; it has {', '.join(sorted(available))}{hint}"
            )
        if key in chosen:
            raise ValueError(f"objects.names: {name!r} names the object {key!r} twice")
        chosen.append(key)
    return chosen


def _written(value: Any, names: Sequence[str]) -> str:
    """Return the one name that the command line would parse as this value; if none or several, the value as text."""
    words = {None: ("null",), True: ("true",), False: ("false",)}
    if value is None or isinstance(value, bool):
        alike = [name for name in names if name.lower() in words[value]]
    else:
        alike = [name for name in names if _is_number(name, value)]
    return alike[0] if len(set(alike)) == 1 else str(value)


def _is_number(name: str, value: float) -> bool:
    try:
        return float(name) == value
    except ValueError:
        return False


class MeshFiles:
    """The objects in a folder, each in one mesh file.

    Args:
        root: the folder.
        files: its mesh files, by object name.
        names: objects to load; None: all.
        aliases: other spellings of names.
        wanted: what the folder should hold, for messages.

    Raises:
        ValueError: there are no files, or ``choose`` refuses the names.
    """

    metric: ClassVar[bool] = True

    def __init__(
        self,
        root: Path,
        files: dict[str, Path],
        names: Sequence[Any] | None,
        aliases: dict[str, str],
        wanted: str,
    ) -> None:
        if not files:
            raise ValueError(f"objects.root: {root} holds no {wanted}")
        self.root = root
        self._files = {name: files[name] for name in choose(files, names, aliases, str(root))}

    def names(self) -> list[str]:
        """Return the names of the chosen objects, in their order."""
        return list(self._files)

    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of each mesh file together with the files that it refers to, without building the mesh.

        Raises:
            ValueError: a mesh refers to a missing file.
        """
        return {name: file_digest(path, *references(path)) for name, path in self._files.items()}

    def load(self) -> list[ObjectMesh]:
        """Load the objects, normalised, in the order of ``names``. Source units are assumed to be metres."""
        digests = self.digests()
        return [load_file(path, name, digests[name]) for name, path in self._files.items()]


def folder_of(root: str | Path) -> Path:
    """Return the folder; raise ``ValueError`` if it does not exist."""
    path = Path(root).expanduser()
    if not path.is_dir():
        raise ValueError(f"objects.root: {path} is not a folder")
    return path

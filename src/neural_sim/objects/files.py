"""Reading and hashing of mesh files, shared by the loaders."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import trimesh
from annotated_types import MinLen
from PIL import Image
from trimesh.visual import TextureVisuals

from neural_sim.objects.mesh import ObjectMesh, normalise
from neural_sim.objects.repair import repair
from neural_sim.pictures import eight_bits

Names = Annotated[list[str], MinLen(1)] | None
"""Which objects of a folder, None: all."""
COMPANIONS = (".mtl", ".png", ".jpg", ".jpeg")
Y_UP_TO_Z_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def file_digest(*paths: Path) -> str:
    """SHA-256 of the files' bytes, in the order given; missing files are skipped."""
    state = hashlib.sha256()
    for path in paths:
        if path.is_file():
            state.update(path.read_bytes())
    return state.hexdigest()


def content_digest(files: Mapping[str, Path]) -> str:
    """SHA-256 of names and contents, whatever the files' folders; a missing file counts as an empty one."""
    lines = (f"{name} {file_digest(path)}\n" for name, path in files.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def load_file(path: Path, name: str, digest: str, metres_per_unit: float = 1.0) -> ObjectMesh:
    """Read, repair and normalise a mesh file; several parts in it are joined.

    glTF files (.glb) have +y up by their standard and are turned to +z up; others are not turned. The object's
    ``transform`` leads back to the file's frame in metres.

    Raises:
        ValueError: a file that cannot be read or has no triangles, with the reason.
    """
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except (
        OSError,
        ValueError,
        KeyError,
        IndexError,
        TypeError,
        NotImplementedError,
        AttributeError,
    ) as error:  # whatever trimesh's loaders raise on broken or unknown files; NotImplementedError is one of theirs
        raise ValueError(f"{path}: object {name!r} cannot be read as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise ValueError(f"{path}: object {name!r} holds a {type(mesh).__name__}, want a triangle mesh")
    _read_textures(mesh, f"{path}: texture")
    mesh = repair(mesh, name, str(path))
    if metres_per_unit != 1.0:
        mesh.apply_scale(metres_per_unit)
    if path.suffix.lower() != ".glb":
        return normalise(mesh, name, str(path), digest)
    mesh.apply_transform(Y_UP_TO_Z_UP)
    item = normalise(mesh, name, str(path), digest)
    return replace(item, transform=np.linalg.inv(Y_UP_TO_Z_UP) @ item.transform)


def _read_textures(mesh: trimesh.Trimesh, where: str) -> None:
    """Decode a mesh's textures to 8 bits, which trimesh does not. Raises ``ValueError`` for damaged ones."""
    material = mesh.visual.material if isinstance(mesh.visual, TextureVisuals) else None
    for key in ("image", "baseColorTexture"):
        image = getattr(material, key, None)
        if isinstance(image, Image.Image):
            setattr(material, key, eight_bits(image, where))


def choose(
    available: dict[str, Path], names: list[str] | None, aliases: dict[str, str], where: str
) -> list[str]:
    """The available names of ``names``, which may be aliases, in their order; for None all of them, sorted.

    Raises:
        ValueError: an unknown name, or one object twice.
    """
    if names is None:
        return sorted(available)
    chosen = []
    for name in names:
        key = name if name in available else aliases.get(name)
        if key is None:
            raise ValueError(
                f"objects.names: {name!r} is not in {where}; there are {', '.join(sorted(available))}"
            )
        if key in chosen:
            raise ValueError(f"objects.names: {name!r} names the object {key!r} twice")
        chosen.append(key)
    return chosen


class MeshFiles:
    """Objects of a folder, one mesh file each.

    Args:
        root: the folder.
        files: its mesh files by the objects' names.
        names: objects to load; None: all.
        aliases: other spellings of names.
        wanted: what the folder should hold, for messages.

    Raises:
        ValueError: no files, or what :func:`choose` raises.
    """

    metric: ClassVar[bool] = True

    def __init__(
        self,
        root: Path,
        files: dict[str, Path],
        names: list[str] | None,
        aliases: dict[str, str],
        wanted: str,
    ) -> None:
        if not files:
            raise ValueError(f"objects.root: {root} holds no {wanted}")
        self.root = root
        self._files = {name: files[name] for name in choose(files, names, aliases, str(root))}

    def names(self) -> list[str]:
        return list(self._files)

    def digests(self) -> dict[str, str]:
        """SHA-256 of each mesh and the material and image files beside it, without parsing them."""
        return {name: file_digest(path, *_companions(path)) for name, path in self._files.items()}

    def load(self) -> list[ObjectMesh]:
        """The objects, normalised, in the order of ``names``. Source units are taken to be metres."""
        digests = self.digests()
        return [load_file(path, name, digests[name]) for name, path in self._files.items()]


def folder_of(root: str | Path) -> Path:
    """The folder; raises ``ValueError`` if it does not exist."""
    path = Path(root)
    if not path.is_dir():
        raise ValueError(f"objects.root: {path} is not a folder")
    return path


def _companions(path: Path) -> list[Path]:
    """Files a mesh may refer to: all materials and images beside it, some of which may be other meshes'."""
    if path.suffix.lower() in (".glb", ".stl"):
        return []
    return sorted(other for other in path.parent.iterdir() if other.suffix.lower() in COMPANIONS)

"""Any folder of meshes: files side by side, or one sub-folder an object."""

from __future__ import annotations

import logging
from pathlib import Path

from neural_sim.objects.files import choose, file_digest, load_file
from neural_sim.objects.mesh import ObjectMesh

log = logging.getLogger(__name__)

# In order of preference where a sub-folder holds the same object in several formats.
FORMATS = (".glb", ".obj", ".ply", ".stl")
COMPANIONS = (".mtl", ".png", ".jpg", ".jpeg")


class MeshFolder:
    """Meshes of a folder (.glb, .obj, .ply, .stl), all of them or those named, +z up.

    A file's object is named by its stem. A sub-folder is one object of that name: its only mesh, or the one that
    comes first in ``FORMATS``; nested folders are searched. Units are taken to be metres (rendering does not
    depend on them). Raises ``ValueError`` for an empty folder, unknown names and two objects of one name.
    """

    def __init__(self, root: str | Path, names: list[str] | None = None) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise ValueError(f"objects.root: {self.root} is not a folder")
        files = self._find()
        if not files:
            raise ValueError(f"objects.root: {self.root} holds no mesh ({', '.join(FORMATS)})")
        self._files = {name: files[name] for name in choose(files, names, {}, str(self.root))}

    def names(self) -> list[str]:
        return list(self._files)

    def digests(self) -> dict[str, str]:
        """SHA-256 of each mesh and the material and image files beside it, without parsing them."""
        return {name: file_digest(path, *_companions(path)) for name, path in self._files.items()}

    def load(self) -> list[ObjectMesh]:
        """The objects, normalised, in the order of ``names``."""
        digests = self.digests()
        return [load_file(path, name, digests[name]) for name, path in self._files.items()]

    def _find(self) -> dict[str, Path]:
        files: dict[str, Path] = {}
        for entry in sorted(self.root.iterdir()):
            if entry.is_dir():
                meshes = sorted(path for path in entry.rglob("*") if _is_mesh(path))
                if not meshes:
                    continue
                path = min(meshes, key=lambda mesh: (FORMATS.index(mesh.suffix.lower()), str(mesh)))
                if len(meshes) > 1:
                    log.warning("%s holds %d meshes; %s is taken", entry, len(meshes), path.name)
                name = entry.name
            elif _is_mesh(entry):
                path, name = entry, entry.stem
            else:
                continue
            if name in files:
                raise ValueError(f"objects.root: {files[name]} and {path} are both named {name!r}")
            files[name] = path
        return files


def _is_mesh(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in FORMATS


def _companions(path: Path) -> list[Path]:
    """Files a mesh may refer to. In a folder of many meshes each depends on all of them: too much, never too little."""
    if path.suffix.lower() in (".glb", ".stl"):
        return []
    return sorted(other for other in path.parent.iterdir() if other.suffix.lower() in COMPANIONS)

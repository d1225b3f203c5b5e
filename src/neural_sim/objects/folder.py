"""Any folder of meshes: files in one folder, or one subfolder for each object."""

from __future__ import annotations

import logging
from pathlib import Path

from neural_sim.objects.files import MeshFiles, Names, folder_of
from neural_sim.pictures import say_strange, without_leftovers
from neural_sim.ranges import validated

log = logging.getLogger(__name__)

# In order of preference, if a subfolder holds one object in several formats.
FORMATS = (".glb", ".obj", ".ply", ".stl", ".gltf")
OTHER_FORMATS = (".fbx", ".dae", ".off", ".3ds", ".3mf", ".blend", ".usd", ".usdz", ".usdc", ".stp", ".drc")
"""Mesh formats that cannot be read."""


@validated
class MeshFolder(MeshFiles):
    """Meshes in a folder (.glb, .obj, .ply, .stl, .gltf), with +z up (+y in glTF), in metres.

    The unit matters only where distances are in metres. A file is one object, named after its stem. A subfolder is one
    object with the folder's name: the only mesh in it or in the folders below, or the first by ``FORMATS``.

    Raises:
        ValueError: the folder does not exist or has no mesh, a name is unknown, or two objects have the same name.
    """

    def __init__(self, root: str | Path, names: Names = None) -> None:
        folder = folder_of(root)
        super().__init__(folder, _find(folder), names, {}, f"mesh ({', '.join(FORMATS)})")


def _find(root: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    say_strange(root, sorted(path for path in root.rglob("*") if path.is_file()), OTHER_FORMATS)
    for entry in without_leftovers(sorted(root.iterdir()), root):
        if entry.is_dir():
            meshes = without_leftovers(sorted(path for path in entry.rglob("*") if _is_mesh(path)), entry)
            if not meshes:
                continue
            path = min(meshes, key=lambda mesh: (FORMATS.index(mesh.suffix.lower()), str(mesh)))
            if len(meshes) > 1:
                log.warning("%s holds %d meshes; %s is used", entry, len(meshes), path.name)
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

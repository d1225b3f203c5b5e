"""A BOP benchmark's ``models`` folder: ``obj_000001.ply`` in millimetres and ``models_info.json``."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import MinLen

from neural_sim.documents import read_json
from neural_sim.objects.files import MeshFiles, folder_of, load_file
from neural_sim.objects.mesh import ObjectMesh
from neural_sim.ranges import validated

log = logging.getLogger(__name__)

MILLIMETRE = 1e-3
# models_info.json rounds, and some of its diameters are measured on denser models.
DIAMETER_TOLERANCE = 0.05


@validated
class BOP(MeshFiles):
    """Objects of a BOP models folder.

    Args:
        root: the folder.
        names: objects as 'obj_000001', '000001', '1' or 1; None: all.

    Raises:
        ValueError: the folder does not exist or has no ``obj_*.ply``, a name is unknown, or a file is not
            named ``obj_`` and a number.
    """

    def __init__(self, root: str | Path, names: Annotated[list[str | int], MinLen(1)] | None = None) -> None:
        folder = folder_of(root)
        files = {path.stem: path for path in folder.glob("obj_*.ply")}
        aliases: dict[str, str] = {}
        for stem in files:
            number = stem.removeprefix("obj_")
            aliases[number] = stem
            aliases[number.lstrip("0") or "0"] = stem
        wanted = None if names is None else [str(name) for name in names]
        super().__init__(folder, files, wanted, aliases, "obj_*.ply; want a BOP models folder")
        strange = [path for name, path in self._files.items() if not name.removeprefix("obj_").isdecimal()]
        if strange:
            raise ValueError(f"objects.root: {strange[0]}: want a number after obj_, as in obj_000001.ply")
        self._info = folder / "models_info.json"

    def load(self) -> list[ObjectMesh]:
        """Load the objects, normalised, in the order of ``names``; their transforms lead back to metres.

        Raises:
            ValueError: a file cannot be read, or the diameter of a mesh is not that in models_info.json, whether the
                file is taken to be in millimetres or in metres.
        """
        diameters, digests = self._diameters(), self.digests()
        items = []
        for name, path in self._files.items():
            item = load_file(path, name, digests[name], MILLIMETRE)
            number = str(int(name.removeprefix("obj_")))
            items.append(self._checked(item, path, diameters.get(number)))
        return items

    def _diameters(self) -> dict[str, float]:
        """Read diameters in millimetres, by object number, from models_info.json; without it, warn and return none."""
        if not self._info.is_file():
            log.warning("%s is missing: the models are assumed to be in millimetres", self._info)
            return {}
        try:
            info = read_json(self._info)
            return {str(int(number)): float(entry["diameter"]) for number, entry in info.items()}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{self._info}: want {{number: {{'diameter': mm}}}}: {error}") from error

    def _checked(self, item: ObjectMesh, path: Path, diameter: float | None) -> ObjectMesh:
        """Check an object against its diameter, and correct its scale if the file is in metres, not millimetres."""
        if diameter is None:
            return item
        measured = _diameter(item) / MILLIMETRE
        if abs(measured / diameter - 1.0) <= DIAMETER_TOLERANCE:
            return item
        if abs(measured / MILLIMETRE / diameter - 1.0) <= DIAMETER_TOLERANCE:
            log.warning("%s is in metres, not millimetres, according to its diameter in %s", path, self._info)
            transform = item.transform.copy()
            transform[:3] /= MILLIMETRE
            return ObjectMesh(item.name, item.mesh, transform, item.digest)
        raise ValueError(
            f"{path}: measures {measured:.4g} mm across, but {self._info.name} says {diameter:.4g}; "
            "want both in millimetres"
        )


def _diameter(item: ObjectMesh) -> float:
    """Return the largest distance between two vertices, in metres; both lie on the convex hull."""
    try:
        points = np.asarray(item.mesh.convex_hull.vertices)
    except (ValueError, RuntimeError):  # flat meshes have no hull; scipy's QhullError is a RuntimeError
        points = np.asarray(item.mesh.vertices)
    farthest = max(float(np.linalg.norm(points - point, axis=1).max()) for point in points)
    return farthest * float(item.transform[0, 0])

"""The YCB benchmark's folder layout: ``<root>/<id>_<name>/google_16k/textured.obj`` with its texture."""

from __future__ import annotations

from pathlib import Path

from neural_sim.objects.files import choose, file_digest, load_file
from neural_sim.objects.mesh import ObjectMesh


class YCB:
    """Objects of a folder in the YCB layout, all of them or those named.

    An entry of ``names`` may be '019_pitcher_base', '019' or 'pitcher_base'; the objects' own names are the folders'.
    Raises ``ValueError`` where the folder holds no such object or a name is unknown.
    """

    def __init__(self, root: str | Path, names: list[str] | None = None) -> None:
        self.root = Path(root)
        if not self.root.is_dir():
            raise ValueError(f"objects.root: {self.root} is not a folder")
        files = {path.parts[-3]: path for path in self.root.glob("*/google_16k/textured.obj")}
        if not files:
            raise ValueError(f"objects.root: {self.root} holds no <id>_<name>/google_16k/textured.obj")
        aliases: dict[str, str] = {}
        for folder in sorted(files):
            number, _, rest = folder.partition("_")
            aliases.setdefault(number, folder)
            aliases.setdefault(rest, folder)
        self._files = {name: files[name] for name in choose(files, names, aliases, str(self.root))}

    def names(self) -> list[str]:
        return list(self._files)

    def digests(self) -> dict[str, str]:
        """SHA-256 of mesh, material and texture files by object, without parsing them."""
        return {name: file_digest(path, *_companions(path)) for name, path in self._files.items()}

    def load(self) -> list[ObjectMesh]:
        """The objects, normalised, in the order of ``names``. Source units are metres."""
        digests = self.digests()
        return [load_file(path, name, digests[name]) for name, path in self._files.items()]


def _companions(path: Path) -> list[Path]:
    return sorted(other for other in path.parent.iterdir() if other.suffix in (".mtl", ".jpg", ".png"))

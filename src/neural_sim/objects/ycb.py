"""The YCB benchmark's folder layout: ``<root>/<id>_<name>/google_16k/textured.obj`` with its texture."""

from __future__ import annotations

from pathlib import Path

from neural_sim.objects.files import MeshFiles, folder_of


class YCB(MeshFiles):
    """Objects of a folder in the YCB layout, all of them or those named.

    An entry of ``names`` may be '019_pitcher_base', '019' or 'pitcher_base'; the objects' own names are the folders'.
    Raises ``ValueError`` where the folder holds no such object or a name is unknown.
    """

    def __init__(self, root: str | Path, names: list[str] | None = None) -> None:
        folder = folder_of(root)
        files = {path.parts[-3]: path for path in folder.glob("*/google_16k/textured.obj")}
        aliases: dict[str, str] = {}
        for name in sorted(files):
            number, _, rest = name.partition("_")
            aliases.setdefault(number, name)
            aliases.setdefault(rest, name)
        super().__init__(folder, files, names, aliases, "<id>_<name>/google_16k/textured.obj")

"""The YCB benchmark's folder layout: ``<root>/<id>_<name>/google_16k/textured.obj`` with its texture."""

from __future__ import annotations

from pathlib import Path

from neural_sim.objects.files import MeshFiles, Names
from neural_sim.ranges import validated

LAYOUT = "<id>_<name>/google_16k/textured.obj"
ORIGIN = (
    "get the google_16k meshes of the YCB Object and Model Set (ycbbenchmarks.com), and put them there or set "
    "objects.root"
)


@validated
class YCB(MeshFiles):
    """Objects of a folder in the YCB layout, named after their folders.

    Args:
        root: the folder.
        names: objects as '019_pitcher_base', '019' or 'pitcher_base'; None: all.

    Raises:
        ValueError: the folder has no such objects, or a name is unknown.
    """

    def __init__(self, root: str | Path, names: Names = None) -> None:
        folder = Path(root).expanduser()
        files = {path.parts[-3]: path for path in folder.glob("*/google_16k/textured.obj")}
        if not files:
            raise ValueError(f"objects.root: {folder} holds no {LAYOUT}; {ORIGIN}")
        aliases: dict[str, str] = {}
        for name in sorted(files):
            number, _, rest = name.partition("_")
            aliases.setdefault(number, name)
            aliases.setdefault(rest, name)
        super().__init__(folder, files, names, aliases, LAYOUT)

"""Task ``box``: a page for setting the box around a photographed object by hand."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Le
from typing_extensions import override

from neural_sim.configuration import UserError
from neural_sim.documents import write_json
from neural_sim.objects.photos import Photos
from neural_sim.objects.pictures import BOX_FILE, Corners
from neural_sim.ranges import NonNegative, validated
from neural_sim.report.box_page import BoxPage, first_box
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task
from neural_sim.tasks.viewer import keep_open

_log = logging.getLogger(__name__)


@validated
@dataclass(frozen=True)
class BoxTask(Task):
    """A page on localhost that stays open until Ctrl-C. ``objects.masks=scene`` reads the box that it saves.

    Args:
        object: name of the object; null: the only one.
        port: port of the page; if it is taken, the next free one.
        seconds: how long the page is open; null: until Ctrl-C.
    """

    object: str | None = None
    port: Annotated[int, Ge(1), Le(65535)] = 8080
    seconds: NonNegative | None = None

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        self._chosen(context)
        return ()

    @override
    def run(self, context: Context) -> None:
        photos, name = self._chosen(context)
        capture = photos.captures[name]

        def save(box: Corners) -> str:
            file = write_json(photos.folder(name) / BOX_FILE, {"box": box})
            _log.info(
                "box of %s saved in %s; objects.masks=scene reads it, unless objects.box is set", name, file
            )
            return f"saved in {file}"

        page = BoxPage(capture, photos.box_of(name) or first_box(capture), save, self.port)
        print(f"open {page.address} (Ctrl-C ends it)", flush=True)
        try:
            keep_open(self.seconds)
        finally:
            page.server.stop()

    def _chosen(self, context: Context) -> tuple[Photos, str]:
        photos = context.experiment.imaging.objects
        if not isinstance(photos, Photos):
            raise UserError("stages=[box] sets the box around a photographed object: want objects=photos")
        names = photos.names()
        name = names[0] if self.object is None and len(names) == 1 else self.object
        if name not in names:
            raise UserError(f"box.object: want one of {', '.join(names)}, got {name}")
        return photos, name

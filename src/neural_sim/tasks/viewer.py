"""Task ``viewer``: a page that shows fields, distributions and detections while it is open."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le
from typing_extensions import override

from neural_sim.interruption import ctrl_c_as_exception
from neural_sim.ranges import NonNegative, validated
from neural_sim.report.viewer import Shots, Viewer
from neural_sim.stages.graph import Psi
from neural_sim.stages.psi_file import psi_of_file
from neural_sim.stages.stage import Stage
from neural_sim.tasks.context import Context, Task


@validated
@dataclass(frozen=True)
class ViewerTask(Task):
    """A page on localhost that stays open until Ctrl-C. Fields and the detector are read from the store, or computed.

    Args:
        psi: distribution that is shown first and that the detector is trained on: ``initial``, ``target``, ``learned``
            (by a run of the same configuration), or a file: a run's folder, its ``results.json``, or an export's
            ``psi.json``.
        port: port of the page; if it is taken, the next free one.
        seconds: how long the page is open; null: until Ctrl-C.
    """

    psi: str = "initial"
    port: Annotated[int, Ge(1), Le(65535)] = 8080
    seconds: NonNegative | None = None

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        if self.psi == "learned":
            return [graph.learned, graph.scene]
        return [graph.trained_on(self._known(context)[self.psi], self.psi)]

    @override
    def run(self, context: Context) -> None:
        viewer = Viewer(self.shots(context), self.port, self.psi)
        print(f"open {viewer.address} (Ctrl-C ends it)", flush=True)
        try:
            keep_open(self.seconds)
        finally:
            viewer.server.stop()

    def shots(self, context: Context) -> Shots:
        """Return the scene, the known distributions, and the detector trained on ``psi``.

        Raises:
            ValueError: the file does not contain psi.
        """
        graph, known, results = context.graph, self._known(context), context.results
        if self.psi == "learned":
            known["learned"] = results(graph.learned).last
        trained = graph.trained_on(known[self.psi], self.psi)
        return Shots(results(graph.scene), known, trained.build(), results(trained).params)

    def _known(self, context: Context) -> dict[str, Psi]:
        """Return the distributions that are known before psi is learned, by name."""
        graph, distribution = context.graph, context.experiment.imaging.distribution
        known = {"initial": graph.psi("initial")}
        if self.psi == "target" or graph.target_psi is not None:
            known["target"] = graph.stated_psi("target", "viewer.psi")
        if self.psi not in ("learned", *known):
            known[self.psi] = psi_of_file(
                Path(self.psi).expanduser(), distribution, graph.names, "viewer.psi"
            )
        return known


def keep_open(seconds: float | None) -> None:
    """Wait until Ctrl-C, or for some seconds."""
    ends = None if seconds is None else time.monotonic() + seconds
    with suppress(KeyboardInterrupt), ctrl_c_as_exception():
        while ends is None or time.monotonic() < ends:
            time.sleep(0.2)

"""Task ``viewer``: a page that shows fields, distributions and detections while it is open."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from neural_sim.report.viewer import Shots, Viewer
from neural_sim.stages.psi_file import psi_of_file
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class ViewerTask:
    """A page on this machine's own address, until Ctrl-C. Fields and the detector are read from the store, or computed.

    Args:
        psi: what is shown first and what the detector was trained on: ``initial``, ``target``, ``learned`` (of a run of
            the same configuration), or a file: a run's folder, its ``results.json``, or an export's ``psi.json``.
        port: of the page; the next free one where it is taken.
        seconds: how long it is open; null: until it is interrupted.

    Raises:
        ValueError: a port or a time out of range.
    """

    psi: str = "initial"
    port: int = 8080
    seconds: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise ValueError(f"viewer.port must lie in 1 to 65535, got {self.port}")
        if self.seconds is not None and not self.seconds >= 0.0:
            raise ValueError(f"viewer.seconds must not be negative, got {self.seconds}")

    def run(self, context: Context) -> None:
        """Open the page and wait.

        Raises:
            ValueError: viser is missing, or a psi that is not in the store or the file.
        """
        viewer = Viewer(self.shots(context), self.port, self.psi)
        print(f"open {viewer.address} (Ctrl-C ends it)", flush=True)
        try:
            self._wait()
        finally:
            viewer.server.stop()

    def _wait(self) -> None:
        ends = None if self.seconds is None else time.monotonic() + self.seconds
        try:
            while ends is None or time.monotonic() < ends:
                time.sleep(0.2)
        except KeyboardInterrupt:
            pass

    def shots(self, context: Context) -> Shots:
        """Return the scene, the known distributions, and the detector trained on ``psi``."""
        graph, distribution = context.graph, context.experiment.imaging.distribution
        known = {"initial": graph.psi("initial")}
        if self.psi == "target" or graph.target_psi is not None:
            known["target"] = graph.stated_psi("target", "viewer.psi")
        if self.psi not in known:
            file = Path(self.psi).expanduser()
            learned = self.psi == "learned"
            known[self.psi] = (
                context.results(graph.learned).last
                if learned
                else psi_of_file(file, distribution, graph.names, "viewer.psi")
            )
        # What the page needs beside psi it makes itself.
        made = ("views", "field", "target_sets", "warm_start", "evaluate")
        results = Results(
            Store(context.experiment.run.store), (*context.stages, *made), context.account.reused
        )
        trained = graph.trained_on(known[self.psi], self.psi)
        return Shots(results(graph.scene), known, trained.build(), results(trained).params)

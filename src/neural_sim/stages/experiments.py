"""Stage ``experiments``: the page of all experiments, as conf/experiment/experiments_table.yaml says."""

from __future__ import annotations

from dataclasses import dataclass

from neural_sim.report.experiments import Experiments
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class ExperimentsStep(Experiments):
    """See :class:`Experiments`."""

    def run(self, context: Context) -> None:
        """Page, tables and figures to the run's folder."""
        print(self.write(context.uri, context.config, context.folder))
        print(f"results: {context.folder}")

"""Stage ``compare``: finished runs side by side, as conf/experiment/compare.yaml says."""

from __future__ import annotations

from dataclasses import dataclass

from neural_sim.report.compare import Compare
from neural_sim.tasks.context import Context


@dataclass(frozen=True)
class CompareStep(Compare):
    """See :class:`Compare`."""

    def run(self, context: Context) -> None:
        """Tables and figures to the run's folder, a run to MLflow."""
        self.compare(context.uri, context.config["seed"], context.config, context.folder)

"""Stage ``stress``: the suite of stiff and extreme cases, as conf/experiment/stress.yaml says."""

from __future__ import annotations

import time
from dataclasses import dataclass

from neural_sim.studies.stress.cases import Suite
from neural_sim.studies.stress.report import report
from neural_sim.tasks.context import Context, TaskFailure


@dataclass(frozen=True)
class StressStep(Suite):
    """See :class:`Suite`."""

    def run(self, context: Context) -> None:
        """Every check to the run's folder and to MLflow.

        Raises:
            TaskFailure: where a check failed, when all is written.
        """
        config, begun = context.config, time.time()
        failed = report(self.run_all(config["seed"], config["progress"]), config, context.folder, begun)
        if failed:
            raise TaskFailure(f"stress: {failed} checks failed")
        context.returned = 0.0

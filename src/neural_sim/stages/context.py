"""The context of a run's stages: its parts, the stages' results, its folder, its account."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from neural_sim.outer.records import IterationRecord
from neural_sim.report.run_tracking import LiveRun, live_run
from neural_sim.report.tracking import tracking_uri
from neural_sim.stages.account import Account
from neural_sim.stages.experiment import Experiment
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store

_log = logging.getLogger(__name__)
T = TypeVar("T")


class StageFailure(RuntimeError):
    """A stage has written its results, which include a failure: the program's exit status is 1."""


class Step(Protocol):
    """An entry of ``stages``: computes or reads results, writes to the run's folder. One that needs stages from objects
    to a report names them in ``needs``; they run before it.
    """

    def run(self, context: Context) -> None: ...


@dataclass
class Context:
    """``build`` makes the experiment when a stage first asks for it: comparisons and the stress suite need none.

    ``returned`` is what the run returns to a sweep, ``live`` its MLflow run while it is open. ``of_method`` makes the
    experiment of the same command with another method (``baseline=...``), where the program can compose it.
    """

    config: dict[str, Any]
    folder: Path
    build: Callable[[], Experiment]
    stages: Sequence[str]
    account: Account = field(default_factory=Account)
    live: LiveRun | None = None
    returned: float | None = None
    of_method: Callable[[str], Experiment] | None = None

    @staticmethod
    def of(experiment: Experiment, folder: Path | None = None) -> Context:
        """Of an experiment that is built already, with the stages that its configuration lists."""
        config = experiment.config
        return Context(config, folder or Path(), lambda: experiment, tuple(config["stages"]))

    @cached_property
    def experiment(self) -> Experiment:
        return self.build()

    @cached_property
    def graph(self) -> Graph:
        return Graph(self.experiment, self._iteration)

    @cached_property
    def results(self) -> Results:
        return Results(Store(self.experiment.run.store), self.stages, self.account.reused)

    @property
    def uri(self) -> str:
        """Of the MLflow store."""
        return tracking_uri(self.config["paths"]["mlflow"])

    def _iteration(self, record: IterationRecord) -> None:
        if self.live:
            self.live.iteration(dataclasses.asdict(record))

    def shown(self, items: Iterable[T], name: str) -> Iterable[T]:
        """``items`` behind a progress bar, if the run shows any."""
        return tqdm(list(items), desc=name, disable=not self.config["progress"], leave=False)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Count the seconds of a stage."""
        begun = time.perf_counter()
        yield
        spent = self.account.seconds[name] = time.perf_counter() - begun
        _log.info("%-11s %8.1f s", name, spent)
        if self.live:
            self.live.stage(name, spent)

    @contextmanager
    def tracked(self) -> Iterator[None]:
        """An MLflow run for what is inside, if the report is asked for."""
        if "report" not in self.stages:
            with nullcontext():
                yield
            return
        x, names = self.experiment, self.graph.names
        biased, method = x.imaging.distribution.biased, x.loop.method.name
        with live_run(self.uri, x.run.name, method, x.run.seed, names, biased, x.config) as self.live:
            _log.info("to watch this run:\n%s", self.live.where)
            yield

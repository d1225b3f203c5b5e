"""The context of a task: configuration, results of stages, output folder and MLflow."""

from __future__ import annotations

import dataclasses
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

from annotated_types import MinLen
from tqdm import tqdm

from neural_sim.configuration import UserError
from neural_sim.documents import write_json, write_whole
from neural_sim.outer.records import IterationRecord
from neural_sim.ranges import Distinct
from neural_sim.report import figures as drawing
from neural_sim.report.figures import Figure
from neural_sim.report.run_tracking import LiveRun, live_run
from neural_sim.report.tracking import Run, flatten, opened, tracking_uri
from neural_sim.stages.account import Account
from neural_sim.stages.experiment import Experiment
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results, Stage
from neural_sim.stages.store import Store
from neural_sim.stages.together import make_together

_log = logging.getLogger(__name__)
T = TypeVar("T")
Methods = Annotated[Sequence[str], MinLen(1), Distinct()]
"""Names of methods, as in ``baseline=...``."""


class TaskFailure(RuntimeError):
    """A task wrote its results, and they report a failure; the program exits with status 1."""


class Task(ABC):
    """An entry of ``stages``: something that a user asks for, as a frozen dataclass of its settings."""

    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        """Return the stages whose results the task will read, as far as they are known before it runs.

        This is called, and the stages are checked, before any task runs, so that bad settings are refused at the start.

        Raises:
            ValueError: the task cannot work with the settings of the run.
        """
        return ()

    @abstractmethod
    def run(self, context: Context) -> None:
        """Do the work: read results, making those that the store lacks, and write to the run's folder."""


@dataclass
class Context:
    """One command: its configuration, the results of stages, its output folder and its MLflow store.

    Args:
        config: the whole configuration as plain values.
        folder: output folder of tasks.
        build: builds the experiment on first use; studies of finished runs need none.
        stages: names of the stages and tasks that the command asks for.
        account: the time spent and the work left out, for the report.
        live: the command's MLflow run while it is open.
        of_method: builds the experiment of the same command with another method (``baseline=...``); None if the
            caller cannot compose it.
        begun: start of the current task, in seconds since 1970.
        logged: seconds per phase that are in the log already.
        command: command line as typed, on one line.
        scale: the choice of ``scale``.
        last_words: text printed when all tasks are done; empty: nothing.
    """

    config: dict[str, Any]
    folder: Path
    build: Callable[[], Experiment]
    stages: Sequence[str]
    account: Account = field(default_factory=Account)
    live: LiveRun | None = None
    of_method: Callable[[str], Experiment] | None = None
    begun: float = field(default_factory=time.time)
    logged: dict[str, float] = field(default_factory=dict)
    command: str = ""
    scale: str = ""
    last_words: str = ""

    @staticmethod
    def of(experiment: Experiment, folder: Path | None = None) -> Context:
        """Return the context of an experiment that has been built, with the stages of its configuration."""
        config = experiment.config
        return Context(config, folder or Path(), lambda: experiment, tuple(config["stages"]))

    @cached_property
    def experiment(self) -> Experiment:
        """The parts of the configuration, built once."""
        return self.build()

    @cached_property
    def graph(self) -> Graph:
        """The experiment's stages."""
        return Graph(self.experiment, self._iteration)

    def graphs_of(self, methods: Sequence[str], key: str) -> dict[str, Graph]:
        """Return the stages of the same command with each method.

        Raises:
            ValueError: a method is unknown, or the context cannot compose; the message names the setting ``key``.
        """
        if self.of_method is None:
            raise ValueError(f"{key}: this context composes no other method's configuration")
        return {method: Graph(self.of_method(method)) for method in methods}

    @cached_property
    def results(self) -> Results:
        """Results of stages, read from the store or computed."""
        run = self.experiment.run
        return Results(Store(run.store), self.account, run.resume)

    @property
    def uri(self) -> str:
        """The MLflow store's address."""
        return tracking_uri(self.config["paths"]["mlflow"])

    def _iteration(self, record: IterationRecord) -> None:
        if self.live:
            self.live.iteration(dataclasses.asdict(record))

    def together(self, stages: Iterable[Stage[Any]]) -> list[Stage[Any]]:
        """Make the stages that the store lacks in parallel, with the run's workers, and return all of them."""
        wanted, run = list(stages), self.experiment.run
        if wanted:
            with self.account.charged(wanted[0].phase):
                make_together(self.results, wanted, run.workers, run.gpus)
        return wanted

    def shown(self, items: Iterable[T], name: str) -> Iterable[T]:
        """Return ``items`` behind a progress bar, if the run shows any."""
        return tqdm(list(items), desc=name, disable=not self.config["progress"], leave=False)

    @contextmanager
    def running(self, name: str) -> Iterator[None]:
        """Charge a task for its time, excluding the phases whose results it reads, and log the time of new phases."""
        self.begun = time.time()
        with self.account.charged(name):
            try:
                yield
            except OSError as error:
                if error.filename is not None:
                    raise
                # Errors of a full or missing disk carry no path.
                why, kept = error.strerror or error, "finished results are kept"
                raise UserError(f"{name}: {self.folder} cannot be written to: {why}; {kept}") from error
        for phase, spent in self.account.seconds.items():
            if phase not in self.logged:
                _log.info("%-11s %8.1f s", phase, spent)
            if self.live and spent != self.logged.get(phase):
                self.live.stage(phase, spent)
        self.logged = dict(self.account.seconds)

    @contextmanager
    def tracked(self) -> Iterator[None]:
        """Keep an MLflow run open inside this context if the command asks for the report."""
        if "report" not in self.stages:
            with nullcontext():
                yield
            return
        method, biased = self.experiment.loop.method.name, self.experiment.imaging.distribution.biased
        names = self.graph.names
        with live_run(self.uri, self.config, method, names, biased, self.begun, self.scale) as self.live:
            _log.info("to watch this run:\n%s", self.live.where)
            yield

    def publish(
        self,
        name: str,
        document: Any,
        text: str | None = None,
        figures: Mapping[str, Figure] | None = None,
        metrics: Mapping[str, float | Sequence[float] | None] | None = None,
        tags: Mapping[str, str] | None = None,
        title: str | None = None,
    ) -> Run | None:
        """Write the results of a task to the folder and to a finished MLflow run; print the text and both locations.

        The MLflow run belongs to the experiment called ``name`` in the configuration and starts when the task started.
        Its artifacts are the whole folder, including what the task wrote there before. Its parameters are the whole
        configuration, or, if no experiment was built, the settings of the task and the seed.

        Args:
            name: name of the files ``<name>.json`` and ``<name>.md``, and of the task's node in the configuration.
            document: content of ``<name>.json``; numbers that are not finite become null.
            text: content of ``<name>.md``, which is printed as well; None: no such file.
            figures: figures by name, written to ``figures/<name>.png``.
            metrics: final numbers, or sequences with one value per step; None and values that are not finite are left
                out.
            tags: further tags of the MLflow run, in addition to the seed.
            title: title of the MLflow run; None: its seed.

        Returns:
            The MLflow run, or None, with a warning, if MLflow cannot be written to.
        """
        write_json(self.folder / f"{name}.json", document)
        if text is not None:
            write_whole(self.folder / f"{name}.md", text.rstrip("\n") + "\n")
            print(text.rstrip("\n"))
        for key, figure in (figures or {}).items():
            drawing.save(figure, self.folder / "figures" / f"{key}.png")
        seed = str(self.config["seed"])
        known = {key: value for key, value in (metrics or {}).items() if value is not None}
        series = {key: value for key, value in known.items() if isinstance(value, Sequence)}
        numbers = {key: value for key, value in known.items() if not isinstance(value, Sequence)}
        whole = "experiment" in self.__dict__  # it was built, so the task depends on the whole configuration
        parameters = self.config if whole else {name: self.config.get(name, {}), "seed": self.config["seed"]}
        tags, title = {"seed": seed, **(tags or {})}, title or f"seed {seed}"
        run = None
        try:
            with opened(self.uri, self.config["name"], title, tags, flatten(parameters), self.begun) as run:
                run.log(numbers)
                run.log_series(series)
                run.log_files(self.folder)
        except ValueError as error:  # only a warning, since the folder has the results
            _log.warning("%s; these results are not in MLflow", error)
        print(f"results: {self.folder}" + (f"\n{run.where}" if run else ""))
        return run

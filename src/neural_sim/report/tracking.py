"""Runs in MLflow: opened when work begins, written to while it runs, and read back later."""

from __future__ import annotations

import logging
import math
import os
import re
import shlex
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.configuration import first_line
from neural_sim.interruption import Interrupted, has_ended, last_act, this_process
from neural_sim.report.database import check_database, database_of, guard, upgrade
from neural_sim.report.provenance import commit

_log = logging.getLogger(__name__)

KIND = ("mlflow.experimentKind", "custom_model_development")
"""The tag that makes MLflow show an experiment as model training, in the versions that read it."""
TRAINING = "workflowType=machine_learning"
"""URL query that opens MLflow's view of training; newer versions default to GenAI and would show an empty page."""
COMMIT = "mlflow.source.git.commit"
"""The tag, shown by MLflow, that holds the commit of a run's code, or ``UNKNOWN``."""
UNKNOWN = "unknown"
SOURCE = {"source": "neural-sim"}
"""The tag of every run that this program opens."""
PROCESS = "neural-sim.process"
"""The tag that says which process opened a run."""
BATCH = 100
"""Rows of one kind in a request; MLflow takes no more parameters at once."""


def tracking_uri(location: str) -> str:
    """Return the URI of a tracking store: a URI unchanged, a path as an absolute path of a SQLite file.

    Raises:
        ValueError: the location is empty.
    """
    if not location:
        raise ValueError("paths.mlflow is empty: want a file such as outputs/mlflow.db or a tracking URI")
    if "://" in location or location == "databricks":
        return location
    return f"sqlite:///{Path(location).expanduser().resolve()}"


def where(uri: str, experiment_id: str, run_id: str | None = None) -> str:
    """Return how to open a run, or an experiment's table of runs: the command that serves it, and its address."""
    path = f"/#/experiments/{experiment_id}/runs" + (f"/{run_id}" if run_id else "") + f"?{TRAINING}"
    if uri.startswith(("http://", "https://")):
        return uri.rstrip("/") + path
    if uri.startswith("databricks"):
        return f"{uri}: experiment {experiment_id}" + (f", run {run_id}" if run_id else "")
    return f"mlflow ui --backend-store-uri {shlex.quote(uri)}\nhttp://127.0.0.1:5000{path}"


class Run:
    """A run that is open in MLflow. Values that are not finite are left out, since MLflow's charts break on them.

    A failed write (an unreachable server, a locked database) does not stop the work: it is logged as a warning, and the
    values are kept and sent with the next write, at the latest when the run is closed. ``clock`` gives the time of the
    rows in seconds since 1970.
    """

    def __init__(self, client: Any, uri: str, info: Any, clock: Callable[[], float] = time.time) -> None:
        self.uri, self.run_id, self.experiment_id = uri, info.run_id, info.experiment_id
        self._client, self._clock, self._waiting = client, clock, []

    @property
    def where(self) -> str:
        """How to open the run in MLflow."""
        return where(self.uri, self.experiment_id, self.run_id)

    def log(self, metrics: Mapping[str, float], step: int = 0) -> None:
        """Write numbers with the current time."""
        self.log_series({key: {step: value} for key, value in metrics.items()})

    def log_series(self, series: Mapping[str, Sequence[float] | Mapping[int, float]]) -> None:
        """Write values by step, or one per step from 0, with the current time."""
        from mlflow.entities import Metric

        now = int(1000 * self._clock())
        for key, values in series.items():
            steps = values.items() if isinstance(values, Mapping) else enumerate(values)
            finite = [(step, float(v)) for step, v in steps if math.isfinite(v)]
            self._waiting += [Metric(_allowed(key), v, now, step) for step, v in finite]
        self._try("its metrics are kept for the next write", self._send)

    def tag(self, key: str, text: str) -> None:
        """Set a tag of the run."""
        self._try(f"it has no tag {key}", lambda: self._client.set_tag(self.run_id, key, text))

    def log_files(self, folder: Path) -> None:
        """Copy a folder to the run's artifacts."""
        self._try(
            f"not all files of {folder} are among its artifacts",
            lambda: self._client.log_artifacts(self.run_id, str(folder)),
        )

    @contextmanager
    def fluent(self) -> Iterator[Any]:
        """Yield the module ``mlflow`` set to this run's store and experiment, to log models, which clients cannot do.

        The experiment stays set afterwards; nothing else in this project reads it.
        """
        with quiet(), guard(self.uri):
            import mlflow

            before = mlflow.get_tracking_uri()
            mlflow.set_tracking_uri(self.uri)
            try:
                mlflow.set_experiment(experiment_id=self.experiment_id)
                yield mlflow
            finally:
                mlflow.set_tracking_uri(before)

    def close(self, status: str, error: BaseException | None = None) -> None:
        """Send waiting values and end the run. Failures are only warnings, as results are in the run's folder too.

        Args:
            status: FINISHED, FAILED or KILLED.
            error: the cause, which becomes a tag.
        """
        self._try("the last metrics are lost", self._send)
        if error is not None:
            self.tag("error", f"{type(error).__name__}: {error}".splitlines()[0][:500])
        self._try(f"it stays open instead of {status}", lambda: self._end(status))

    def parameters(self, parameters: Mapping[str, Any]) -> None:
        """Write the configuration."""
        from mlflow.entities import Param

        pairs = [Param(_allowed(key), str(value)[:6000]) for key, value in parameters.items()]
        for start in range(0, len(pairs), BATCH):
            with guard(self.uri):
                self._client.log_batch(self.run_id, params=pairs[start : start + BATCH])

    def _send(self) -> None:
        while self._waiting:
            with guard(self.uri):
                self._client.log_batch(self.run_id, metrics=self._waiting[:BATCH])
            del self._waiting[:BATCH]

    def _end(self, status: str) -> None:
        with guard(self.uri):
            self._client.set_terminated(self.run_id, status, int(1000 * self._clock()))

    def _try(self, otherwise: str, act: Callable[[], object]) -> None:
        from mlflow.exceptions import MlflowException
        from sqlalchemy.exc import SQLAlchemyError

        try:
            act()
        except (MlflowException, SQLAlchemyError, OSError) as error:
            _log.warning("mlflow: run %s: %s (%s)", self.run_id, otherwise, first_line(error))


@contextmanager
def opened(
    uri: str,
    experiment: str,
    name: str,
    tags: Mapping[str, str],
    parameters: Mapping[str, Any],
    begun: float | None = None,
    clock: Callable[[], float] = time.time,
) -> Iterator[Run]:
    """Open a run, which ends as FINISHED, as FAILED after an exception, or as KILLED after SIGTERM or Ctrl-C.

    A SQLite store is created and written to under a lock, so that the workers of a sweep can share it. Runs that a
    killed process of this machine left open are closed first, see ``close_abandoned``.

    Args:
        uri: URI of the store.
        experiment: name of the experiment, which is created if it does not exist.
        name: name of the run.
        tags: tags of the run.
        parameters: the configuration, flattened.
        begun: when the work began, in seconds since 1970; None: now.
        clock: gives the time in seconds since 1970.

    Raises:
        ValueError: the store cannot be written to.
    """
    with quiet():
        from mlflow.exceptions import MlflowException
        from sqlalchemy.exc import SQLAlchemyError

        start = int(1000 * (clock() if begun is None else begun))
        try:
            client = connect(uri)
            with guard(uri):
                close_abandoned(client)
                experiment_id = _experiment_id(client, uri, experiment)
                tags = {**tags, **SOURCE, PROCESS: this_process(), COMMIT: commit() or UNKNOWN}
                created = client.create_run(experiment_id, start_time=start, run_name=name, tags=tags)
        except (MlflowException, SQLAlchemyError) as error:
            raise ValueError(f"paths.mlflow: {uri} cannot be written to ({first_line(error)})") from error
    run = Run(client, uri, created.info, clock)
    try:
        with last_act(lambda error: run.close("KILLED", error)):
            try:
                run.parameters(parameters)
            except (MlflowException, SQLAlchemyError) as error:
                raise ValueError(f"paths.mlflow: {uri} cannot be written to ({first_line(error)})") from error
            yield run
    except BaseException as error:
        run.close("KILLED" if _interrupted(error) else "FAILED", error)
        raise
    run.close("FINISHED")


def close_abandoned(client: Any) -> list[str]:
    """End the runs that processes of this machine left open when they were killed.

    Returns:
        The ids of the runs, which are now KILLED; the log names each.
    """
    source = " and ".join(f"tags.{key} = '{value}'" for key, value in SOURCE.items())
    ids = [experiment.experiment_id for experiment in client.search_experiments()]
    found = client.search_runs(ids, f"attributes.status = 'RUNNING' and {source}") if ids else []
    closed: list[str] = []
    for run in found:
        if has_ended(run.data.tags.get(PROCESS, "")):
            client.set_tag(run.info.run_id, "error", "its process ended without closing it")
            client.set_terminated(run.info.run_id, "KILLED")
            _log.info(
                "mlflow: run %s (%s) is KILLED: its process is gone", run.info.run_id, run.info.run_name
            )
            closed.append(run.info.run_id)
    return closed


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings into dotted keys, by which MLflow can filter parameters."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def _allowed(name: str) -> str:
    """Replace the characters that MLflow does not allow but that an object's name may contain."""
    return re.sub(r"[^/\w.\- :]", "_", name)


def _interrupted(error: BaseException) -> bool:
    """Check whether a signal or Ctrl-C caused the exception, which may be the SystemExit that Lightning raises."""
    kinds = (Interrupted, KeyboardInterrupt)
    return any(isinstance(each, kinds) for each in (error, error.__context__, error.__cause__))


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the messages of MLflow and its database on import and when a store is created."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for noisy in ("mlflow", "alembic", "sqlalchemy"):
            logging.getLogger(noisy).setLevel(logging.WARNING)
        # It logs the traceback of each error that it raises, which our own message states in one line.
        logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
        yield


def connect(uri: str) -> Any:
    """Return a client of a store, which is created if it is a SQLite file that does not exist yet.

    Raises:
        ValueError: the file is not an MLflow database, or of a version that the installed MLflow does not know.
    """
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    database = database_of(uri)
    if database is not None:
        check_database(database)
    try:
        with guard(uri):
            if database is not None:
                upgrade(database)
            client = MlflowClient(tracking_uri=uri)
            client.search_experiments(max_results=1)  # creates the tables of a new database
    except MlflowException:
        raise
    except OSError as error:  # raised by the lock next to the database
        why = error.strerror or error
        raise ValueError(f"paths.mlflow: {uri} cannot be written to ({why}); set paths.mlflow") from error
    except Exception as error:  # raised by SQLAlchemy and Alembic on databases with another schema
        raise ValueError(
            f"paths.mlflow: {uri} cannot be used ({first_line(error)}); a newer MLflow may have written it: move it "
            "away, or set paths.mlflow"
        ) from error
    return client


def _experiment_id(client: Any, uri: str, name: str) -> str:
    """Return the id of the experiment, which is created if it does not exist; tag it as model training if untagged."""
    from mlflow.exceptions import MlflowException

    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        database = database_of(uri)
        location = None if database is None else (database.parent / "mlartifacts" / name).as_uri()
        try:
            return client.create_experiment(name, artifact_location=location, tags=dict([KIND]))
        except MlflowException as error:  # another machine has just created it on the server
            _log.info("mlflow: %s", error)
            experiment = client.get_experiment_by_name(name)
            if experiment is None:
                raise
    if KIND[0] not in experiment.tags:
        client.set_experiment_tag(experiment.experiment_id, *KIND)
    return experiment.experiment_id


@dataclass(frozen=True)
class LoggedRun:
    """A run in the tracking store.

    Args:
        run_id: id in MLflow.
        name: name in MLflow.
        status: FINISHED, FAILED, ...
        commit: commit of its code, or ``UNKNOWN``.
        parameters: its configuration as MLflow stores it, flattened and as text.
        files: names of its artifacts.
        fetch: downloads an artifact and returns its path.
    """

    run_id: str
    name: str
    status: str
    commit: str
    parameters: Mapping[str, str]
    files: frozenset[str]
    fetch: Callable[[str], Path]


def logged_runs(uri: str, experiment: str) -> list[LoggedRun]:
    """Read all runs of an experiment that are not deleted, the latest first.

    Raises:
        ValueError: there is no experiment with this name.
    """
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    with quiet():
        client = connect(uri)
        order, found, token = ["attributes.start_time DESC"], [], None
        experiment_id = _known_id(client, uri, experiment)
        while token != "":
            page = client.search_runs([experiment_id], order_by=order, page_token=token)
            found += [_logged(client, run) for run in page]
            token = page.token or ""
    return found


def experiments(uri: str) -> list[str]:
    """Return the names of the experiments that are not deleted."""
    with quiet():
        return sorted(experiment.name for experiment in connect(uri).search_experiments())


def where_runs(uri: str, experiment: str) -> str:
    """Return how to open an experiment's table of runs, see ``where``.

    Raises:
        ValueError: there is no experiment with this name.
    """
    with quiet():
        return where(uri, _known_id(connect(uri), uri, experiment))


def _logged(client: Any, run: Any) -> LoggedRun:
    info = run.info
    files = frozenset(item.path for item in client.list_artifacts(info.run_id))
    return LoggedRun(
        info.run_id, info.run_name, info.status, run.data.tags.get(COMMIT, UNKNOWN), run.data.params, files,
        lambda name: Path(client.download_artifacts(info.run_id, name)),
    )  # fmt: skip


def _known_id(client: Any, uri: str, experiment: str) -> str:
    logged = client.get_experiment_by_name(experiment)
    if logged is None:
        known = sorted(e.name for e in client.search_experiments() if e.name != "Default")
        raise ValueError(f"compare.experiments: {uri} has no experiment {experiment!r}, only {known}")
    return logged.experiment_id

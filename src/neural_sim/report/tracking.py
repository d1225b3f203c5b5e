"""A run in MLflow: one per method and seed, its stages as metric prefixes, figures and files as artifacts."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)


def tracking_uri(location: str) -> str:
    """The URI of a tracking store: a URI as it is, a path as a SQLite file with an absolute path.

    Raises:
        ValueError: an empty location.
    """
    if not location:
        raise ValueError("paths.mlflow is empty: want a file such as outputs/mlflow.db or a tracking URI")
    if "://" in location or location == "databricks":
        return location
    return f"sqlite:///{Path(location).resolve()}"


def log_run(
    uri: str,
    experiment: str,
    name: str,
    tags: Mapping[str, str],
    parameters: Mapping[str, Any],
    metrics: Mapping[str, float],
    series: Mapping[str, Sequence[float] | Mapping[int, float]],
    artifacts: Path,
) -> str:
    """Write one finished run and return its id.

    ``series`` holds a value a step (``psi/pitcher/bin_3``), or values by their steps, ``metrics`` final numbers
    (``evaluate/learned/ap``). Non-finite values are left out, since MLflow's charts break on them. A new SQLite store
    is created once, under a lock, so that sweep workers that start together do not race for its tables.
    """
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mlflow import MlflowClient
        from mlflow.entities import Metric, Param, RunTag

        for noisy in ("mlflow", "alembic", "sqlalchemy"):
            logging.getLogger(noisy).setLevel(logging.WARNING)
        client = _client(MlflowClient, uri)
        experiment_id = _experiment_id(client, uri, experiment)
        run = client.create_run(experiment_id, run_name=name, tags=dict(tags))
        run_id = run.info.run_id
        now = run.info.start_time
        rows = [Metric(k, float(v), now, 0) for k, v in metrics.items() if math.isfinite(v)]
        for key, values in series.items():
            steps = values.items() if isinstance(values, Mapping) else enumerate(values)
            rows += [Metric(key, float(v), now, step) for step, v in steps if math.isfinite(v)]
        pairs = [Param(k, str(v)[:6000]) for k, v in parameters.items()]
        for start in range(0, max(len(rows), len(pairs), 1), 100):
            window = slice(start, start + 100)
            client.log_batch(
                run_id, metrics=rows[window], params=pairs[window], tags=[RunTag("source", "neural-sim")]
            )
        client.log_artifacts(run_id, str(artifacts))
        client.set_terminated(run_id)
    return run_id


@dataclass(frozen=True)
class LoggedRun:
    """A run in the tracking store. ``files`` are the names of its artifacts, which ``fetch`` brings here one by one."""

    run_id: str
    name: str
    status: str
    files: frozenset[str]
    fetch: Callable[[str], Path]


def runs(uri: str, experiment: str) -> list[LoggedRun]:
    """All runs of an experiment that are not deleted, the latest first.

    Raises:
        ValueError: no experiment of that name.
    """
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mlflow import MlflowClient

        client = _client(MlflowClient, uri)
        found = client.get_experiment_by_name(experiment)
        if found is None:
            known = sorted(e.name for e in client.search_experiments() if e.name != "Default")
            raise ValueError(f"compare.experiments: {uri} has no experiment {experiment!r}, only {known}")
        order, logged, token = ["attributes.start_time DESC"], [], None
        while token != "":
            page = client.search_runs([found.experiment_id], order_by=order, page_token=token)
            logged += [_logged(client, run.info) for run in page]
            token = page.token or ""
    return logged


def _logged(client: Any, info: Any) -> LoggedRun:
    files = frozenset(item.path for item in client.list_artifacts(info.run_id))

    def fetch(name: str) -> Path:
        return Path(client.download_artifacts(info.run_id, name))

    return LoggedRun(info.run_id, info.run_name, info.status, files, fetch)


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys, as MLflow's parameters are filtered by."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{name}."))
        else:
            flat[name] = value
    return flat


def _client(make: Any, uri: str) -> Any:
    if not uri.startswith("sqlite:///"):
        return make(tracking_uri=uri)
    import fcntl

    database = Path(uri.removeprefix("sqlite:///"))
    database.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{database}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        client = make(tracking_uri=uri)
        client.search_experiments(max_results=1)
    return client


def _experiment_id(client: Any, uri: str, name: str) -> str:
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is None:
        location = None
        if uri.startswith("sqlite:///"):
            location = (Path(uri.removeprefix("sqlite:///")).parent / "mlartifacts" / name).as_uri()
        try:
            return client.create_experiment(name, artifact_location=location)
        except MlflowException as error:  # another worker was first
            _log.info("mlflow: %s", error)
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    return found.experiment_id

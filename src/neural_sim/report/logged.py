"""Runs read back from MLflow."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neural_sim.report.tracking import COMMIT, UNKNOWN, connect, quiet, where


@dataclass(frozen=True)
class LoggedRun:
    """A run in the tracking store. ``files`` are the names of its artifacts, which ``fetch`` brings here one by one;
    ``parameters`` is its configuration as MLflow keeps it, flat and as text.
    """

    run_id: str
    name: str
    status: str
    commit: str
    parameters: Mapping[str, str]
    files: frozenset[str]
    fetch: Callable[[str], Path]


def runs(uri: str, experiment: str) -> list[LoggedRun]:
    """All runs of an experiment that are not deleted, the latest first.

    Raises:
        ValueError: no experiment of that name.
    """
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    with quiet():
        client = connect(uri)
        order, logged, token = ["attributes.start_time DESC"], [], None
        experiment_id = _experiment_id(client, uri, experiment)
        while token != "":
            page = client.search_runs([experiment_id], order_by=order, page_token=token)
            logged += [_logged(client, run) for run in page]
            token = page.token or ""
    return logged


def experiments(uri: str) -> list[str]:
    """Names of the experiments that are not deleted."""
    with quiet():
        return sorted(experiment.name for experiment in connect(uri).search_experiments())


def where_runs(uri: str, experiment: str) -> str:
    """How to look at an experiment's table of runs, see :func:`tracking.where`.

    Raises:
        ValueError: no experiment of that name.
    """
    with quiet():
        return where(uri, _experiment_id(connect(uri), uri, experiment))


def _logged(client: Any, run: Any) -> LoggedRun:
    info = run.info
    files = frozenset(item.path for item in client.list_artifacts(info.run_id))

    def fetch(name: str) -> Path:
        return Path(client.download_artifacts(info.run_id, name))

    commit = run.data.tags.get(COMMIT, UNKNOWN)
    return LoggedRun(info.run_id, info.run_name, info.status, commit, run.data.params, files, fetch)


def _experiment_id(client: Any, uri: str, experiment: str) -> str:
    logged = client.get_experiment_by_name(experiment)
    if logged is None:
        known = sorted(e.name for e in client.search_experiments() if e.name != "Default")
        raise ValueError(f"compare.experiments: {uri} has no experiment {experiment!r}, only {known}")
    return logged.experiment_id

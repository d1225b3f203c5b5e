"""Workers that do the work of a command: processes on this machine, or the machines of a Ray cluster.

RAY_ADDRESS names the cluster; without it, a local one is started, which ends with the command. All machines of a
cluster need this package and must see the output folder under the same path. If a worker or a machine is lost,
another one repeats its work.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import platform
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from logging.handlers import QueueHandler
from pathlib import Path
from typing import Any, Literal

import torch
from typing_extensions import override

from neural_sim.configuration import first_line
from neural_sim.extras import require
from neural_sim.interruption import signals_kept
from neural_sim.processes import Here, Submit, Work, WorkersLost, processes

Workers = int | Literal["ray"]
"""Number of processes, or a Ray cluster."""
RETRIES = 3
"""How often work is repeated after its worker was lost; limited, since some work may crash every worker."""


@contextmanager
def workers(kind: Workers, most: int, work: Work) -> Iterator[Submit]:
    """Start workers and yield a function that submits arguments to them.

    Their log records are passed on to the loggers of this process.

    Args:
        kind: number of processes, or a cluster.
        most: number of arguments that will be submitted; no more processes than that are started.
        work: what the workers do.

    Raises:
        WorkersLost: workers were killed from outside.
        ValueError: the cluster cannot be used; the message is one line.
    """
    with _cluster(work) if kind == "ray" else processes(max(min(kind, most), 1), work) as submit:
        yield submit


@contextmanager
def _cluster(work: Work) -> Iterator[Submit]:
    ray = _connected()
    mark = work.folder.resolve() / f".seen-{uuid.uuid4().hex[:8]}"
    mark.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if work.gpus and not any(machine.get("GPU") for machine in machines):
        raise ValueError(
            "workers=ray: no machine of the cluster has a GPU; want trainer=cpu, or a machine with one"
        )
    cores = max((int(machine.get("CPU", 0)) for machine in machines), default=0)
    place = _Place(mark, os.getcwd(), work.threads, logging.getLogger().getEffectiveLevel(), _code())
    task = ray.put(pickle.dumps(work.task))
    resources = {"num_cpus": min(work.threads, cores or work.threads), "num_gpus": work.gpus}
    remote = ray.remote(**resources, max_retries=RETRIES)(_done)
    left: dict[Future[Any], Any] = {}

    def submit(argument: Any) -> Future[Any]:
        result: Future[Any] = Future()
        # In a list, the task stays a reference, which only a process that lacks it resolves.
        left[result] = handed = remote.remote(place, [task], argument)
        result.add_done_callback(left.pop)
        handed.future().add_done_callback(lambda outcome: _settle(result, outcome))
        return result

    try:
        yield submit
    except ray.exceptions.RayTaskError as error:  # raised outside the task itself, whose errors are results
        raise ValueError(f"workers=ray: {type(error.cause).__name__}: {first_line(error.cause)}") from error
    except ray.exceptions.RayError as error:
        raise WorkersLost(f"workers of the cluster were lost ({first_line(error)})") from error
    finally:
        with suppress(ray.exceptions.RayError, OSError):
            for handed in list(left.values()):
                ray.cancel(handed, force=True)
        with suppress(OSError):
            mark.unlink()


def _connected() -> Any:
    """Return Ray, connected to a cluster for the rest of this process."""
    require("ray", "workers=ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with signals_kept():
        import ray

        if not ray.is_initialized():
            address = os.environ.get("RAY_ADDRESS", "local")
            own: dict[str, Any] = {"include_dashboard": False} if address == "local" else {}
            try:
                ray.init(address, log_to_driver=False, logging_level=logging.WARNING, **own)
            except Exception as error:  # Ray raises the bare class if a machine is too slow to start
                wanted = "" if own else f" RAY_ADDRESS={address}"
                raise ValueError(f"workers=ray:{wanted} cannot be used ({first_line(error)})") from error
    return ray


@dataclass(frozen=True)
class _Place:
    """What a worker needs to set itself up like the process that it works for."""

    mark: Path
    folder: str
    threads: int
    level: int
    code: str

    @property
    def name(self) -> str:
        return self.mark.name

    def enter(self) -> None:
        with suppress(OSError):  # inputs may have relative paths; they work if this folder is shared, too
            os.chdir(self.folder)
        if not self.mark.exists():
            raise ValueError(
                f"workers=ray: {platform.node()} does not see {self.mark.parent}; want a path that all machines share"
            )
        if _code() != self.code:
            raise ValueError(f"workers=ray: {platform.node()} has another version of neural_sim or of torch")
        torch.set_num_threads(self.threads)


@dataclass(frozen=True)
class _Outcome:
    """Result or error for one argument, with the log records of its computation."""

    records: list[logging.LogRecord]
    value: Any = None
    error: Exception | None = None


_kept: tuple[str, Callable[[Any], Any]] | None = None
"""Name and task of the last work that this process did."""


def _done(place: _Place, task: list[Any], argument: Any) -> _Outcome:
    """Do the work for one argument, in a process of the cluster."""
    global _kept
    records = _Records()
    logging.basicConfig(level=place.level, handlers=[records], format="%(message)s", force=True)
    try:
        if _kept is None or _kept[0] != place.name:
            place.enter()
            import ray

            _kept = place.name, pickle.loads(ray.get(task[0]))
        return _Outcome(records.buffer, _kept[1](argument))
    except Exception as error:
        return _Outcome(records.buffer, error=error)


class _Records(QueueHandler):
    """Collects log records in a form that can be sent to another process."""

    def __init__(self) -> None:
        self.buffer: list[logging.LogRecord] = []
        super().__init__(None)  # pyright: ignore[reportArgumentType]

    @override
    def enqueue(self, record: logging.LogRecord) -> None:
        self.buffer.append(record)


def _settle(result: Future[Any], outcome: Future[_Outcome]) -> None:
    """Set the result to what a worker of the cluster returned, or to the error that lost it."""
    lost = outcome.exception()
    if lost is not None:
        result.set_exception(lost)
        return
    done = outcome.result()
    for record in done.records:
        Here().handle(record)
    if done.error is not None:
        result.set_exception(done.error)
    else:
        result.set_result(done.value)


@cache
def _code() -> str:
    """Return a digest of the package sources and the torch version, since results depend on both."""
    total = hashlib.sha256(torch.__version__.encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        total.update(path.read_bytes())
    return total.hexdigest()

"""Processes that share the work of a command and end with it."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from logging.handlers import QueueHandler, QueueListener
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import torch
from typing_extensions import override

Submit = Callable[[Any], Future[Any]]
"""Submits an argument of the task to the workers and returns the future of its result."""

_task: Callable[[Any], Any] | None = None


@dataclass(frozen=True)
class Work:
    """Work for processes on this machine or on the machines of a cluster.

    Attributes:
        task: function that is called with each argument. It must be picklable; each worker receives it once.
        folder: folder of the results, which every worker must see.
        threads: torch threads in each worker. Results depend on it, because the order of summation does.
        gpus: fraction of a GPU that is reserved for each argument on a cluster.
    """

    task: Callable[[Any], Any]
    folder: Path
    threads: int
    gpus: float = 0.0


class WorkersLost(ValueError):
    """Workers were killed from outside or could not start; results that they had finished are kept."""


@contextmanager
def processes(count: int, work: Work) -> Iterator[Submit]:
    """Start processes and yield a function that submits arguments to them.

    Their log records are passed on to the loggers of this process. They ignore Ctrl-C and end with this process.

    Raises:
        WorkersLost: a process was killed or could not start.
    """
    context = multiprocessing.get_context("spawn")
    records: Any = context.Queue()
    listener = QueueListener(records, Here())
    with _stored(work.task) as path:
        arguments = (path, work.threads, records, logging.getLogger().getEffectiveLevel())
        pool = ProcessPoolExecutor(count, context, initializer=_begin, initargs=arguments)

        def submit(argument: Any) -> Future[Any]:
            try:
                return pool.submit(_run, argument)
            except OSError as error:  # the system allows no further process
                reason = f"a process could not start ({error.strerror or error}); want fewer workers"
                raise WorkersLost(reason) from error

        listener.start()
        try:
            yield submit
        except BrokenProcessPool as error:
            reason = "a process was killed from outside, perhaps because memory ran out, or could not start"
            raise WorkersLost(reason) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
            listener.stop()
            records.close()


@contextmanager
def _stored(task: Callable[[Any], Any]) -> Iterator[str]:
    """Yield the path of a file that holds the task while the context is open.

    As an argument of a process, the task would go through a pipe. If the process ended before it had read all of it,
    this one would wait forever, as it holds the other end of the pipe itself.
    """
    with tempfile.NamedTemporaryFile(prefix="neural-sim-") as file:
        try:
            file.write(pickle.dumps(task))
            file.flush()
        except OSError as error:
            raise ValueError(f"workers: {file.name} cannot be written: {error.strerror or error}") from error
        yield file.name


class Here(logging.Handler):
    """Passes log records of other processes to the loggers of the same names in this one."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        own = logging.getLogger(record.name)
        if own.isEnabledFor(record.levelno):
            own.handle(record)


def _begin(path: str, threads: int, records: Any, level: int) -> None:
    global _task
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.basicConfig(level=level, handlers=[QueueHandler(records)], format="%(message)s", force=True)
    _task = pickle.loads(Path(path).read_bytes())


def _end_with_parent() -> None:
    """End this process with its parent; it would wait for the next task forever otherwise."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _run(argument: Any) -> Any:
    if _task is None:
        raise RuntimeError("this process has no task")
    return _task(argument)

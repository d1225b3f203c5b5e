"""Processes that share the work of a command and end with it."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
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
    """Workers were killed from outside; results that they had finished are kept."""


@contextmanager
def processes(count: int, work: Work) -> Iterator[Submit]:
    """Start processes and yield a function that submits arguments to them.

    Their log records are passed on to the loggers of this process. They ignore Ctrl-C and end with this process.

    Raises:
        WorkersLost: replaces a ``BrokenProcessPool`` raised inside.
    """
    context = multiprocessing.get_context("spawn")
    records: Any = context.Queue()
    listener = QueueListener(records, Here())
    arguments = (pickle.dumps(work.task), work.threads, records, logging.getLogger().getEffectiveLevel())
    pool = ProcessPoolExecutor(count, context, initializer=_begin, initargs=arguments)
    listener.start()
    try:
        yield lambda argument: pool.submit(_run, argument)
    except BrokenProcessPool as error:
        raise WorkersLost("a process was killed from outside, perhaps because memory ran out") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        listener.stop()
        records.close()


class Here(logging.Handler):
    """Passes log records of other processes to the loggers of the same names in this one."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        own = logging.getLogger(record.name)
        if own.isEnabledFor(record.levelno):
            own.handle(record)


def _begin(pickled: bytes, threads: int, records: Any, level: int) -> None:
    global _task
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.basicConfig(level=level, handlers=[QueueHandler(records)], format="%(message)s", force=True)
    _task = pickle.loads(pickled)


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

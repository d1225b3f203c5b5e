"""Processes that share a command's work, and end with it."""

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
"""Hands the task's argument to workers, and returns what will have the result."""

_task: Callable[[Any], Any] | None = None


@dataclass(frozen=True)
class Work:
    """What workers do, whether they are processes of this machine or of a cluster's machines.

    Attributes:
        task: is called with each argument. It must be picklable; a worker gets it once.
        folder: where it writes, which every worker must see.
        threads: torch threads in each worker. Sums depend on their number, so results do.
        gpus: part of a GPU that an argument takes on a cluster.
    """

    task: Callable[[Any], Any]
    folder: Path
    threads: int
    gpus: float = 0.0


class WorkersLost(ValueError):
    """Workers were ended from outside; what they had finished stands."""


@contextmanager
def processes(count: int, work: Work) -> Iterator[Submit]:
    """Begin processes that do some work.

    What they log appears in this process's log. Ctrl-C reaches this process alone, with which they end.

    Raises:
        WorkersLost: in place of ``BrokenProcessPool`` inside.
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
        raise WorkersLost("a process was ended from outside, perhaps for want of memory") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        listener.stop()
        records.close()


class Here(logging.Handler):
    """Hands records of other processes to the loggers of the same names here."""

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
    """End this process with its parent: it would wait for its next task forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _run(argument: Any) -> Any:
    if _task is None:
        raise RuntimeError("a process without a task")
    return _task(argument)

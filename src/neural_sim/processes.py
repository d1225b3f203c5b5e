"""Processes that share a command's work, and end with it."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from logging.handlers import QueueHandler, QueueListener
from multiprocessing.connection import wait
from typing import Any

import torch
from typing_extensions import override

_task: Callable[[Any], Any] | None = None


@contextmanager
def processes(
    count: int, task: Callable[[Any], Any], threads: int
) -> Iterator[tuple[ProcessPoolExecutor, Callable[[Any], Any]]]:
    """Begin processes that run ``task``, which each gets once.

    What they log appears in this process's log. Ctrl-C reaches this process alone, with which they end.

    Args:
        count: number of processes.
        task: what they do; it must be picklable.
        threads: threads of torch's in each. Sums depend on their number, so results do.

    Yields:
        The processes, and what is to be submitted to them with the task's argument.
    """
    context = multiprocessing.get_context("spawn")
    records: Any = context.Queue()
    listener = QueueListener(records, _Here())
    arguments = (pickle.dumps(task), threads, records, logging.getLogger().getEffectiveLevel())
    pool = ProcessPoolExecutor(count, context, initializer=_begin, initargs=arguments)
    listener.start()
    try:
        yield pool, _run
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        listener.stop()
        records.close()


class _Here(logging.Handler):
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
    logging.basicConfig(level=level, handlers=[QueueHandler(records)], force=True)
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

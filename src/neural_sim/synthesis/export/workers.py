"""The same task for many numbers, in this process or in several."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import wait
from typing import Any, TypeVar

import torch

T = TypeVar("T")
_task: Callable[[int], Any] | None = None


def each(task: Callable[[int], T], numbers: Sequence[int], workers: int) -> Generator[T, None, None]:
    """``task`` of each number, in their order.

    Every process computes with one thread of torch's, so that results do not depend on how many there are. ``workers``
    is their number, 0: this process alone. The task, which they get once, must be picklable.
    """
    if workers == 0:
        yield from _here(task, numbers)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        min(workers, max(len(numbers), 1)), context, initializer=_start, initargs=(pickle.dumps(task),)
    )
    try:
        yield from pool.map(_run, numbers)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _here(task: Callable[[int], T], numbers: Sequence[int]) -> Generator[T, None, None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for number in numbers:
            yield task(number)
    finally:
        torch.set_num_threads(threads)


def _start(pickled: bytes) -> None:
    global _task
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _task = pickle.loads(pickled)


def _end_with_parent() -> None:
    """A worker whose parent is killed would wait for its next number forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _run(number: int) -> Any:
    if _task is None:
        raise RuntimeError("a worker without a task")
    return _task(number)

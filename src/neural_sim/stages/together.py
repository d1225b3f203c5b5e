"""Stages that need nothing of each other, made side by side by workers that share the store."""

from __future__ import annotations

import logging
import pickle
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any

import torch

from neural_sim.processes import Work, WorkersLost
from neural_sim.stages.stage import Results, Stage
from neural_sim.stages.store import Store
from neural_sim.workers import Workers, workers

_log = logging.getLogger(__name__)


def make_together(results: Results, stages: Iterable[Stage[Any]], by: Workers, gpus: float = 0.0) -> None:
    """Make what the store lacks of some stages and of what they need, each as soon as its own inputs are there.

    Results are those of one process bit for bit: every worker computes with as many threads as this one. Nothing is
    made where no two of the stages could be made at one time.

    Args:
        results: whose store gets the results.
        stages: what is wanted.
        by: number of processes, or a cluster.
        gpus: part of a GPU that a stage takes on a cluster.

    Raises:
        ValueError: as making the stages one after another, and for a cluster that cannot be used.
    """
    if by == 1:
        return
    missing = {stage.entry: stage for stage in results.missing(stages) if stage.stored}
    waiting = {name: set(_needed(stage, missing)) for name, stage in missing.items() if _can_be_sent(stage)}
    # What needs a stage that stays here stays here, too.
    while kept := {name for name, needed in waiting.items() if not needed <= waiting.keys()}:
        waiting = {name: needed for name, needed in waiting.items() if name not in kept}
    if _most_at_once(waiting) < 2:
        return
    root = results.store.root.resolve()
    work = Work(_Make(root, results.resume), root, torch.get_num_threads(), gpus)
    who = "the machines of a Ray cluster" if by == "ray" else f"up to {by} processes"
    _log.info("%d results, made by %s", len(waiting), who)
    try:
        with workers(by, len(waiting), work) as submit:
            running: dict[Future[None], str] = {}
            while waiting or running:
                for name in [name for name, needed in waiting.items() if not needed]:
                    del waiting[name]
                    running[submit(missing[name])] = name
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    future.result()
                    made = running.pop(future)
                    results.seen(made)
                    for needed in waiting.values():
                        needed.discard(made)
    except WorkersLost as lost:
        _log.warning("%s: the rest is made one by one", lost)


class _Make:
    """Makes stages in a process, which keeps what they share."""

    def __init__(self, store: Path, resume: bool) -> None:
        self._store, self._resume = store, resume
        self._results: Results | None = None

    def __call__(self, stage: Stage[Any]) -> None:
        if self._results is None:
            self._results = Results(Store(self._store), resume=self._resume)
        self._results(stage)


def _needed(stage: Stage[Any], missing: Mapping[str, Stage[Any]]) -> Iterator[str]:
    """Find the missing results that a stage needs, itself or through what is not stored."""
    for needed in stage.needed:
        if needed.entry in missing:
            yield needed.entry
        elif not needed.stored:
            yield from _needed(needed, missing)


def _can_be_sent(stage: Stage[Any]) -> bool:
    try:
        pickle.dumps(stage)
    except (pickle.PicklingError, AttributeError, TypeError):
        _log.info("%s: made by this process, for it cannot be sent to another", stage.title)
        return False
    return True


def _most_at_once(needs: Mapping[str, set[str]]) -> int:
    """Count the results that are as far from the first ones as each other, at most."""
    depth: dict[str, int] = {}
    while len(depth) < len(needs):
        for name, needed in needs.items():
            if name not in depth and needed <= depth.keys():
                depth[name] = max((depth[one] + 1 for one in needed), default=0)
    return max(Counter(depth.values()).values(), default=0)

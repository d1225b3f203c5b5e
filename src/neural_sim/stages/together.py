"""Make independent stages in parallel, by workers that share the store."""

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
    """Make the stages, and those that they need, if the store lacks them; each as soon as its inputs are ready.

    Results equal those of one process bit for bit, since every worker uses as many threads as this one. Nothing is made
    if no two of the stages could be made at the same time.

    Args:
        results: results whose store the workers share.
        stages: stages to make.
        by: number of processes, or a cluster.
        gpus: fraction of a GPU that a stage takes on a cluster.

    Raises:
        ValueError: making a stage raises it, or the cluster cannot be used.
    """
    if by == 1:
        return
    missing = {stage.entry: stage for stage in results.missing(stages) if stage.stored}
    waiting = {name: set(_needed(stage, missing)) for name, stage in missing.items() if _can_be_sent(stage)}
    # A stage that needs a result made by this process is made by this process, too.
    while kept := {name for name, needed in waiting.items() if not needed <= waiting.keys()}:
        waiting = {name: needed for name, needed in waiting.items() if name not in kept}
    if _most_at_once(waiting) < 2:
        return
    root = results.store.root.resolve()
    work = Work(_Make(root, results.resume), root, torch.get_num_threads(), gpus)
    where = "on the machines of a Ray cluster" if by == "ray" else f"in up to {by} processes"
    _log.info("making %d results %s", len(waiting), where)
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
    """Makes stages in a worker, which keeps in memory what they share."""

    def __init__(self, store: Path, resume: bool) -> None:
        self._store, self._resume = store, resume
        self._results: Results | None = None

    def __call__(self, stage: Stage[Any]) -> None:
        if self._results is None:
            self._results = Results(Store(self._store), resume=self._resume)
        self._results(stage)


def _needed(stage: Stage[Any], missing: Mapping[str, Stage[Any]]) -> Iterator[str]:
    """Find the missing results that a stage needs, directly or through inputs that are not stored."""
    for needed in stage.needed:
        if needed.entry in missing:
            yield needed.entry
        elif not needed.stored:
            yield from _needed(needed, missing)


def _can_be_sent(stage: Stage[Any]) -> bool:
    try:
        pickle.dumps(stage)
    except (pickle.PicklingError, AttributeError, TypeError):
        _log.info("%s: made by this process, because it cannot be sent to another", stage.title)
        return False
    return True


def _most_at_once(needs: Mapping[str, set[str]]) -> int:
    """Return the largest number of results at the same depth of the graph, an estimate of how many run at once."""
    depth: dict[str, int] = {}
    while len(depth) < len(needs):
        for name, needed in needs.items():
            if name not in depth and needed <= depth.keys():
                depth[name] = max((depth[one] + 1 for one in needed), default=0)
    return max(Counter(depth.values()).values(), default=0)

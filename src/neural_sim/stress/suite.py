"""The stress suite: families of cases by name, run one after another."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from tqdm import tqdm

from neural_sim.stress.cases import CASES, Result, Scope, run_case

FAMILIES = (
    "linear", "linear_edges", "inner", "estimators", "sampling", "simplex", "rendering", "imaging", "outer", "data",
)  # fmt: skip
"""One file each, in the order of the loop: its cases are the functions marked ``@case``."""


@dataclass(frozen=True)
class Suite:
    """Runs every case of ``families``; ``full`` False takes smaller versions of the heavy ones.

    Raises:
        ValueError: an unknown family, or none.
    """

    families: Sequence[str] = FAMILIES
    full: bool = True

    def __post_init__(self) -> None:
        if not self.families or not set(self.families) <= set(FAMILIES):
            raise ValueError(
                f"stress.families wants some of {', '.join(FAMILIES)}, got {list(self.families)}"
            )

    def names(self) -> list[str]:
        """The cases, ``family/case``, family by family."""
        for family in self.families:
            importlib.import_module(f"{__package__}.{family}")
        return [name for family in self.families for name in CASES if name.split("/")[0] == family]

    def run_all(self, seed: int, progress: bool = False) -> list[Result]:
        """All results; a case that fails or raises does not keep the others from running."""
        scope, names = Scope(seed, self.full), self.names()
        shown = tqdm(names, desc="stress", disable=not progress, leave=False)
        with _quiet():
            return [result for name in shown for result in run_case(name, scope)]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings in the log: the cases provoke them, and statuses are what they check."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)

"""Runs that begin together share the work: what another one is making comes last."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
from typing_extensions import override

from neural_sim.stages.stage import Results, Stage
from neural_sim.stages.store import Store, locked


@dataclass(frozen=True)
class Number(Stage[int]):
    """A result that is its name."""

    phase: ClassVar[str] = "field"
    kind: ClassVar[str] = "field"

    number: int

    @property
    @override
    def title(self) -> str:
        return f"number {self.number}"

    @override
    def make(self, results: Results) -> int:
        return self.number


class Killed(Exception):
    """What ends a run here."""


@dataclass(frozen=True)
class Work(Number):
    """Counts the times that it was begun."""

    @override
    def make(self, results: Results) -> int:
        checkpoint = results.checkpoint(self)
        begun = 1 + (checkpoint.read() or {"begun": 0})["begun"]
        checkpoint.offer(lambda: {"begun": begun})
        if begun < self.number:
            raise Killed
        return begun


def test_work_is_taken_up_unless_it_is_to_begin_anew(tmp_path):
    def run(resume=True):
        return Results(Store(tmp_path), resume=resume)(Work(3))

    for resume in (True, True, False, True):
        with pytest.raises(Killed):
            run(resume)
    assert run() == 3 and not list(tmp_path.glob("*/*.checkpoint"))
    assert run(resume=False) == 3  # a result that stands is read


def test_what_another_run_is_making_comes_last(tmp_path, caplog):
    stages = [Number(i) for i in range(4)]
    store = Store(tmp_path)
    results = Results(store)
    assert results(stages[1]) == 1  # known, whoever has its lock
    caplog.set_level("INFO")
    made = []
    with (
        locked(tmp_path / "field" / f"{stages[0].key}.pt"),
        locked(tmp_path / "field" / f"{stages[1].key}.pt"),
    ):
        assert store.busy("field", stages[0].key) and not store.busy("field", stages[2].key)
        for stage in results.free_first(stages):
            if stage is stages[0]:
                break
            made.append(results(stage))
    assert made == [1, 2, 3]
    assert [record.getMessage() for record in caplog.records] == [
        "number 0: another run is making it; this run returns to it later"
    ]
    assert [results(stage) for stage in Results(store).free_first(stages)] == [0, 1, 2, 3]

"""Stages, each with its inputs, its key and how its result is made and stored; and the evaluation of stages."""

from __future__ import annotations

import dataclasses
import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

from neural_sim.checkpoint import Checkpoint
from neural_sim.digests import digest
from neural_sim.stages.account import Account
from neural_sim.stages.describe import describe, modules_of
from neural_sim.stages.store import Store
from neural_sim.stages.version import code_version

T = TypeVar("T")

_log = logging.getLogger(__name__)

UNKEYED = {"key": False}
"""Metadata of a dataclass field that the key leaves out."""


class Stage(ABC, Generic[T]):
    """One step of a run: a frozen dataclass whose fields are inputs (stages, or tuples of stages) and settings.

    The key of the result covers the settings, the keys of the inputs, and the version of the code: the modules that
    define the stage and its settings, with all that they import. Fields whose metadata is ``UNKEYED`` are left out:
    they only affect speed and messages, or their content is covered by other fields.
    """

    phase: str
    """The phase of a run that is charged for the result."""
    kind: str
    """The folder of the store that holds the result."""
    keep: ClassVar[bool] = True
    """Whether a run keeps the result in memory once it has read it."""
    stored: ClassVar[bool] = True
    """Whether the result goes to the store; a result that is quickly assembled from its inputs stays in memory."""

    @property
    def early(self) -> bool:
        """True if the result is made before all others, because the user's data for it may be unusable."""
        return False

    def check(self) -> None:
        """Raise the errors of ``make`` that can be detected without the results of other stages.

        Raises:
            ValueError: as ``make`` does.
        """

    @property
    @abstractmethod
    def title(self) -> str:
        """Return a description of the result, for messages."""

    @abstractmethod
    def make(self, results: Results) -> T:
        """Return the result, made from the results of the inputs."""

    def pack(self, value: T) -> Any:
        """Return the result as tensors, numbers, strings, and lists and dictionaries of these."""
        return value

    def unpack(self, stored: Any) -> T:
        """Return the result that was packed."""
        return stored

    @property
    def inputs(self) -> Iterator[Stage[Any]]:
        """The stages whose results this one needs."""
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, field.name)
            for item in value if isinstance(value, tuple) else (value,):
                if isinstance(item, Stage):
                    yield item

    @cached_property
    def description(self) -> dict[str, Any]:
        """Everything that the result depends on."""
        settings: dict[str, Any] = {}
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            if field.metadata.get("key", True):
                settings[field.name] = self._describe(getattr(self, field.name))
        modules = {type(self).__module__, *modules_of(settings)}
        return {"kind": self.kind, **settings, "code": code_version(modules)}

    @staticmethod
    def _describe(value: Any) -> Any:
        if isinstance(value, Stage):
            return {"stage": value.key}
        if isinstance(value, tuple) and any(isinstance(item, Stage) for item in value):
            return [{"stage": item.key} if isinstance(item, Stage) else describe(item) for item in value]
        return describe(value)

    @property
    def needed(self) -> Iterator[Stage[Any]]:
        """The inputs whose results ``make`` reads: all of them, unless a stage says otherwise."""
        return self.inputs

    @cached_property
    def key(self) -> str:
        """The key of the result in the store."""
        return digest(self.description)

    @property
    def entry(self) -> str:
        """Kind and key, which locate the result in every store."""
        return f"{self.kind} {self.key}"


class Results:
    """Evaluates stages: takes a result from memory, reads it from the store, or makes it.

    Args:
        store: store of results.
        account: account that is charged for every result and notes those found in the store.
        resume: whether to resume unfinished work of earlier runs instead of starting again.
    """

    def __init__(self, store: Store, account: Account | None = None, resume: bool = True) -> None:
        self.store, self._account = store, Account() if account is None else account
        self.resume = resume
        self._kept: dict[str, Any] = {}
        self._seen: set[str] = set()

    def __call__(self, stage: Stage[T]) -> T:
        """Return the stage's result."""
        name = stage.entry
        if name in self._kept:
            return self._kept[name]
        with self._account.charged(stage.phase):
            value = self._stored(stage, name) if stage.stored else stage.make(self)
        if stage.keep:
            self._kept[name] = value
        return value

    def _stored(self, stage: Stage[T], name: str) -> T:
        entry = self.store.fetch(
            stage.kind, stage.key, stage.description, lambda: stage.pack(stage.make(self))
        )
        if entry.reused and name not in self._seen:
            self._account.reused(stage.phase, stage.title, entry.seconds)
        self._seen.add(name)
        return stage.unpack(entry.value)

    def seen(self, entry: str) -> None:
        """Note that another process of this run made a result, so that it is not reported as found in the store."""
        self._seen.add(entry)

    def checkpoint(self, stage: Stage[Any], classes: Sequence[type] = (), every: float = 0.0) -> Checkpoint:
        """Return the checkpoint of a stage that is being made, see ``Checkpoint`` and ``Store``.

        Args:
            stage: the stage.
            classes: dataclasses that occur in its state.
            every: smallest number of seconds between two writes.
        """
        store, kind, key = self.store, stage.kind, stage.key
        if not self.resume:
            store.forget(kind, key)
        return Checkpoint(
            lambda: store.state(kind, key, classes), lambda state: store.keep(kind, key, state), every
        )

    def free_first(self, stages: Iterable[Stage[T]]) -> Iterator[Stage[T]]:
        """Yield the stages, leaving for last those that another run is making, which may be finished by then.

        Runs that start together thus share the work instead of all waiting for the same result.
        """
        later: list[Stage[T]] = []
        for stage in stages:
            known = stage.entry in self._kept or self.store.has(stage.kind, stage.key)
            if stage.stored and not known and self.store.busy(stage.kind, stage.key):
                _log.info("%s: another run is making it; this run returns to it later", stage.title)
                later.append(stage)
            else:
                yield stage
        yield from later

    def missing(self, stages: Iterable[Stage[Any]]) -> list[Stage[Any]]:
        """Return all stages that would have to be computed to evaluate these, inputs first."""
        found: list[Stage[Any]] = []
        seen = set(self._kept)

        def visit(stage: Stage[Any]) -> None:
            name = stage.entry
            if name in seen:
                return
            seen.add(name)
            if stage.stored and self.store.has(stage.kind, stage.key):
                return
            for needed in stage.needed:
                visit(needed)
            found.append(stage)

        for stage in stages:
            visit(stage)
        return found

    def check(self, stages: Iterable[Stage[Any]]) -> list[Stage[Any]]:
        """Raise now the errors that evaluating the stages might otherwise raise after minutes of other work.

        Returns:
            The stages that would be computed, see ``missing``. Early ones among them have been made already.

        Raises:
            ValueError: as evaluating the stages does.
        """
        missing = self.missing(stages)
        for stage in missing:
            stage.check()
        for stage in missing:
            if stage.early:
                self(stage)
        return missing

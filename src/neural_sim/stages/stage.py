"""A stage: its inputs, the key of its result, how that is computed and stored. And the evaluation of stages."""

from __future__ import annotations

import dataclasses
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

from neural_sim.digests import digest
from neural_sim.stages.describe import describe, modules_of
from neural_sim.stages.store import Entry, Store
from neural_sim.stages.version import code_version

T = TypeVar("T")
_log = logging.getLogger(__name__)


UNKEYED = {"key": False}
"""Metadata of a dataclass field that the key leaves out."""


class Stage(ABC, Generic[T]):
    """A frozen dataclass. Its fields that are stages, alone or in a tuple, are its inputs; the rest are settings.

    The key of the result covers the settings, the keys of the inputs, and the version of all code that the stage's
    module and its settings' modules import. Fields whose metadata is ``UNKEYED`` are left out: they affect how fast a
    result is computed, or follow from other fields.
    """

    name: str
    """The stage that ``stages=[...]`` must list in order to compute a result that is not stored."""
    kind: str
    """The folder of the store."""
    keep: ClassVar[bool] = True
    """Whether a run keeps the result in memory once it has read it."""
    stored: ClassVar[bool] = True
    """Whether the result goes to the store; what is quickly put together from inputs stays in memory."""

    @property
    @abstractmethod
    def title(self) -> str:
        """The result in words, for messages."""

    @abstractmethod
    def make(self, results: Results) -> T:
        """The result, from those of the inputs."""

    def pack(self, value: T) -> Any:
        """The result as tensors, numbers, strings, and lists and dictionaries of these."""
        return value

    def unpack(self, stored: Any) -> T:
        """Inverse of :meth:`pack`."""
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
        """All that the result depends on."""
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
        """The inputs whose results :meth:`make` reads: all of them, unless a stage says otherwise."""
        return self.inputs

    @cached_property
    def key(self) -> str:
        """Of the result in the store."""
        return digest(self.description)


class Results:
    """Evaluates stages: a result is read once, from memory or the store, or computed from its inputs' results.

    Args:
        store: where results are kept.
        asked: names of the stages that may be computed; results of others must be in the store.
        reused: called with every result that the store had.
    """

    def __init__(
        self, store: Store, asked: Collection[str], reused: Callable[[Stage[Any], Entry], None] | None = None
    ) -> None:
        self._store, self._asked, self._reused = store, tuple(asked), reused
        self._kept: dict[str, Any] = {}
        self._checked: set[str] = set()

    def __call__(self, stage: Stage[T]) -> T:
        """The stage's result.

        Raises:
            ValueError: a result that the store lacks, of a stage that was not asked for.
        """
        name = f"{stage.kind} {stage.key}"
        if name in self._kept:
            return self._kept[name]

        def make() -> Any:
            self._refuse_unasked(stage)
            return stage.pack(stage.make(self))

        if not stage.stored:
            self._kept[name] = stage.make(self)
            return self._kept[name]
        entry = self._store.fetch(stage.kind, stage.key, stage.description, make)
        if entry.reused and self._reused is not None:
            self._reused(stage, entry)
        value = stage.unpack(entry.value)
        if stage.keep:
            self._kept[name] = value
        return value

    def check(self, stage: Stage[Any]) -> None:
        """Refuse now what evaluating the stage would refuse, perhaps after minutes of work on other results.

        Raises:
            ValueError: as evaluating it.
        """
        name = f"{stage.kind} {stage.key}"
        if name in self._kept or name in self._checked:
            return
        if stage.stored:
            if self._store.has(stage.kind, stage.key):
                return
            self._refuse_unasked(stage)
        for needed in stage.needed:
            self.check(needed)
        self._checked.add(name)

    def _refuse_unasked(self, stage: Stage[Any]) -> None:
        if stage.name not in self._asked:
            raise ValueError(
                f"stages: {stage.title} is not in {self._store.root}; add stage {stage.name} to {list(self._asked)}"
            )

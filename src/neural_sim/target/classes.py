"""The classes of a data set, and their mapping to objects of the run."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

_log = logging.getLogger(__name__)

Unmatched = Literal["refuse", "leave_out"]


@dataclass(frozen=True)
class ClassMap:
    """Maps the classes of a data set to objects.

    Args:
        mapping: class -> object, None to leave a class out. Classes not listed have the names of their objects. None
            lists no class.
        source: the data set, for messages.
        key: the setting that holds the mapping, for messages.
        kind: the data set's words for a class and for several classes, for messages.
        unmatched: what to do with a class that is not an object: ``refuse`` the data set, or ``leave_out`` the class;
            None: refuse, and there is no setting to choose otherwise.
    """

    mapping: Mapping[str, str | None] | None
    source: object
    key: str = "target.classes"
    kind: tuple[str, str] = ("class", "classes")
    unmatched: Unmatched | None = "refuse"

    def check_listed(self, names: Collection[str]) -> None:
        """Raise ``ValueError`` for a class of the mapping that is not among ``names``."""
        strange = sorted(set(self._named) - set(names))
        if strange:
            raise ValueError(
                f"{self.key}: {strange} are not {self.kind[1]} of {self.source}, which has {list(names)}"
            )

    def object_of(self, name: str) -> str | None:
        """Return the name of a class's object; None for a class that is left out."""
        return self._named.get(name, name)

    @cached_property
    def _named(self) -> dict[str, str | None]:
        """The mapping as text: numbers that the command line parsed (``{0: mug}``) are names, too."""
        return {str(key): None if name is None else str(name) for key, name in (self.mapping or {}).items()}

    def labels(self, names: Collection[str], objects: Sequence[str]) -> dict[str, int | None]:
        """Return the labels of classes, positions in ``objects``; None for those that the mapping leaves out.

        Classes that are not objects are missing. Objects without a class give a warning.
        """
        named, place = {name: self.object_of(name) for name in names}, {o: i for i, o in enumerate(objects)}
        for lacking in sorted(set(objects) - set(named.values())):
            _log.warning("%s: no %s for object %s, which gets no score", self.source, self.kind[0], lacking)
        return {
            name: None if found is None else place[found]
            for name, found in named.items() if found is None or found in place
        }  # fmt: skip

    def refuse(self, names: Collection[str], objects: Sequence[str]) -> None:
        """Raise ``ValueError`` for classes that are not objects, unless these may be left out."""
        named = {name: self.object_of(name) for name in names}
        strange = sorted(
            name if name == found else f"{name} (as {found})"
            for name, found in named.items() if found not in (None, *objects)
        )  # fmt: skip
        if strange and self.unmatched != "leave_out":
            more = "" if self.unmatched is None else ", or set target.unmatched=leave_out"
            raise ValueError(
                f"{self.source}: {self.kind[1]} {strange} are not objects; objects are {list(objects)}. Map them by "
                f"{self.key}, {{{self.kind[0]}: object}} or {{{self.kind[0]}: null}} to leave one out{more}"
            )

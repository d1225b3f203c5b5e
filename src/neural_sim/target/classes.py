"""The classes of a data set, and the objects of the run that they are."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

_log = logging.getLogger(__name__)

Unmatched = Literal["refuse", "leave_out"]


@dataclass(frozen=True)
class ClassMap:
    """Which object a class of a data set is.

    Args:
        mapping: class -> object, None to leave a class out. Classes not listed stand for themselves; None: none is.
        source: the data set, for messages.
        key: the setting that has the mapping, for messages.
        kind: what the data set calls a class, and several, for messages.
        unmatched: what becomes of a class that is no object: ``refuse`` the data set, or ``leave_out`` the class; None:
            refuse it, and there is no setting to choose.
    """

    mapping: Mapping[str, str | None] | None
    source: object
    key: str = "target.classes"
    kind: tuple[str, str] = ("class", "classes")
    unmatched: Unmatched | None = "refuse"

    def check_listed(self, names: Collection[str]) -> None:
        """Raise ``ValueError`` for a class of the mapping that is none of ``names``."""
        strange = sorted(set(self._named) - set(names))
        if strange:
            raise ValueError(
                f"{self.key}: {strange} are no {self.kind[1]} of {self.source}, which has {list(names)}"
            )

    def object_of(self, name: str) -> str | None:
        """Return the name of the object that a class is, None for a class that is left out."""
        return self._named.get(name, name)

    @property
    def _named(self) -> dict[str, str | None]:
        """The mapping as text: what the command line took for numbers (``{0: mug}``) are names, too."""
        return {str(key): None if name is None else str(name) for key, name in (self.mapping or {}).items()}

    def labels(self, names: Collection[str], objects: Sequence[str]) -> dict[str, int | None]:
        """Return the labels of classes, positions in ``objects``, None for those that the mapping leaves out.

        Classes that are no objects are missing. Objects without a class are warned of.
        """
        named = {name: self.object_of(name) for name in names}
        for lacking in sorted(set(objects) - set(named.values())):
            _log.warning("%s: no %s for object %s, which gets no score", self.source, self.kind[0], lacking)
        return {
            name: None if found is None else list(objects).index(found)
            for name, found in named.items() if found is None or found in objects
        }  # fmt: skip

    def refuse(self, names: Collection[str], objects: Sequence[str]) -> None:
        """Raise ``ValueError`` for classes that are no objects, if there are any and they are not to be left out."""
        named = {name: self.object_of(name) for name in names}
        strange = sorted(
            name if name == found else f"{name} (as {found})"
            for name, found in named.items() if found not in (None, *objects)
        )  # fmt: skip
        if strange and self.unmatched != "leave_out":
            more = "" if self.unmatched is None else ", or set target.unmatched=leave_out"
            raise ValueError(
                f"{self.source}: {self.kind[1]} {strange} are no objects; objects are {list(objects)}. Map them by "
                f"{self.key}, {{{self.kind[0]}: object}} or {{{self.kind[0]}: null}} to leave one out{more}"
            )

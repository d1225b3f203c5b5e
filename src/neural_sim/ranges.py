"""Ranges of settings, declared once in the types of a class's arguments and checked whenever one is constructed.

    @validated
    @dataclass(frozen=True)
    class Loop:
        iterations: PositiveInt = 10
        start: Literal["fresh", "warm"] = "fresh"
        radius: PositiveFraction | None = None
        distances: Annotated[tuple[Positive, Positive], Ascending()] = (2.4, 4.0)

``Loop(radius=2)`` raises "Loop.radius: want more than 0 and at most 1 or null, got 2". The command line checks its YAML
against the same types before it makes anything, and names the whole key. Numbers must be finite, whatever is declared.
A condition on several arguments is code in ``__post_init__``, which runs after these checks.
"""

from __future__ import annotations

import functools
import inspect
import math
import pkgutil
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Annotated, Any, Literal, TypeVar, Union

from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Le, Lt, MaxLen, MinLen, MultipleOf

from neural_sim.configuration import UserError

PositiveInt = Annotated[int, Ge(1)]
NonNegativeInt = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Ge(0), Le(1)]
PositiveFraction = Annotated[float, Gt(0), Le(1)]


@dataclass(frozen=True)
class Ascending(BaseMetadata):
    """Marks a sequence whose values do not decrease, or increase ``strictly``."""

    strictly: bool = False


@dataclass(frozen=True)
class Distinct(BaseMetadata):
    """Marks a sequence in which no value is repeated."""


@dataclass(frozen=True)
class Matching(BaseMetadata):
    """Marks a value that has to pass ``test``; ``wanted`` says in words what passes."""

    test: Callable[[Any], bool]
    wanted: str


@dataclass(frozen=True)
class With(BaseMetadata):
    """Marks an argument that is given, that is, not null, if and only if the argument ``other`` is."""

    other: str


@dataclass(frozen=True)
class Misfit:
    """A value that does not fit its type: where it stands, what is wanted, what was got (None: the key is unknown)."""

    where: str
    wanted: str
    got: str | None

    def __str__(self) -> str:
        if self.got is None:
            return f"{self.where}: unknown key, want {self.wanted}"
        return f"{self.where}: want {self.wanted}, got {self.got}"


_Class = TypeVar("_Class", bound=type)
_SCALARS = (str, int, float, type(None))  # what YAML has; other objects are not checked here
_WORDS = {
    int: "a whole number",
    float: "a number",
    str: "a string",
    bool: "true or false",
    type(None): "null",
}
_PLURALS = {int: "whole numbers", float: "numbers", str: "strings"}


def validated(made: _Class) -> _Class:
    """Check a class's arguments against their declared types and ranges whenever it is constructed.

    Args:
        made: a dataclass, or a class with an annotated ``__init__``.

    Returns:
        The class itself. Constructing it raises ``UserError`` for an argument that does not fit.
    """
    construct = made.__init__

    @functools.wraps(construct)
    def check_and_construct(self: Any, *args: Any, **kwargs: Any) -> None:
        given = dict(zip(list(arguments(made))[: len(args)], args, strict=False)) | kwargs
        hints = hints_of(made)
        for name, value in given.items():
            check(value, hints.get(name, Any), f"{type(self).__name__}.{name}")
        check_together(given, hints, type(self).__name__)
        construct(self, *args, **kwargs)

    made.__init__ = check_and_construct
    made.__validated__ = True
    return made


def check(value: Any, hint: Any, where: str) -> None:
    """Raise ``UserError`` in one line for a value that does not fit a type.

    Args:
        value: a scalar, a list or mapping of them, or an object. A mapping with a ``_target_`` stands for what that
            makes: its keys are checked against the arguments of its target.
        hint: a type, with ranges as ``Annotated`` markers.
        where: the value's key.
    """
    found = misfit(value, hint, where)
    if found is not None:
        raise UserError(str(found))


def check_together(values: Mapping[str, Any], hints: Mapping[str, Any], where: str) -> None:
    """Raise ``UserError`` if one of two values that belong together is given and the other one is not.

    Args:
        values: arguments of a class by name; those that are left out count as null.
        hints: their types, some of which may be marked by ``With``.
        where: the key of the class.
    """
    for name, hint in hints.items():
        for other in (marker.other for marker in parted(hint)[1] if isinstance(marker, With)):
            one, two = values.get(name), values.get(other)
            if (one is None) != (two is None):
                raise UserError(f"{where}.{name}: want {name} and {other} or neither, got {one} and {two}")


@functools.cache
def arguments(make: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """Return the arguments of a class or function by name."""
    return inspect.signature(make).parameters


@functools.cache
def hints_of(make: Callable[..., Any]) -> Mapping[str, Any]:
    """Return the types of a class's or function's arguments, with their markers."""
    # A dataclass's own hints are resolved where each field was declared, which may be another module.
    whole = is_dataclass(make) or not isinstance(make, type)
    return typing.get_type_hints(make if whole else make.__init__, include_extras=True)


def misfit(value: Any, hint: Any, where: str) -> Misfit | None:
    """Find the first part of a value that does not fit a type. For the arguments see ``check``."""
    hint, markers = parted(hint)
    plain = hint in _WORDS or typing.get_origin(hint) is Literal
    if isinstance(value, Mapping) and "_target_" in value and not plain:
        return _misfit_of_node(value, where)
    if typing.get_origin(hint) in (Union, types.UnionType):
        found = _misfit_of_union(value, typing.get_args(hint), where)
    elif isinstance(value, Mapping):
        found = _misfit_of_mapping(value, hint, where)
    elif isinstance(value, (list, tuple)):
        found = _misfit_of_sequence(value, hint, where)
    elif isinstance(value, _SCALARS):
        found = None if _fits(value, hint) else Misfit(where, words_of(hint), repr(value))
    else:
        return None
    described = next((marker.wanted for marker in markers if isinstance(marker, Matching)), None)
    if found is not None and found.where == where and described is not None:
        return replace(found, wanted=described)
    return found or _misfit_of_markers(value, markers, where)


def parted(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without its markers, and all its markers, including those inside groups."""
    while typing.get_origin(hint) in (typing.Required, typing.NotRequired):
        (hint,) = typing.get_args(hint)
    if typing.get_origin(hint) is not Annotated:
        return Any if hint is object else hint, ()
    bare, *markers = typing.get_args(hint)
    flat: list[Any] = []
    for marker in markers:
        flat += list(marker) if isinstance(marker, GroupedMetadata) else [marker]
    return bare, tuple(flat)


def words_of(hint: Any) -> str:
    """Describe in words what fits a type, apart from its ranges."""
    hint, _ = parted(hint)
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hint in _WORDS:
        return _WORDS[hint]
    if origin is Literal:
        return _one_of(inner)
    if origin in (Union, types.UnionType):
        return " or ".join(words_of(one) for one in inner)
    if typing.is_typeddict(hint) or _is_a(origin or hint, Mapping):
        return "a mapping"
    if _is_a(origin or hint, Iterable):
        element = parted(inner[0])[0] if inner else None
        of = f" of {_PLURALS[element]}" if element in _PLURALS else ""
        return f"a list{of}"
    return f"a group with a _target_, such as {getattr(hint, '__name__', hint)}"


def _misfit_of_node(node: Mapping[str, Any], where: str) -> Misfit | None:
    """Check the keys and values of a mapping against the arguments of the ``_target_`` that it names."""
    name = node["_target_"]
    try:
        make = pkgutil.resolve_name(name) if isinstance(name, str) else None
    except (ImportError, AttributeError, ValueError) as error:
        return Misfit(f"{where}._target_", "the name of a class or function", f"{name!r} ({error})")
    if not callable(make):
        return Misfit(f"{where}._target_", "the name of a class or function", repr(name))
    known, hints = arguments(make), hints_of(make)
    takes_any = any(argument.kind is argument.VAR_KEYWORD for argument in known.values())
    for key, value in node.items():
        if key.startswith("_"):
            continue
        if key not in known and not takes_any:
            return Misfit(f"{where}.{key}", f"one of {', '.join(known)}", None)
        found = misfit(value, hints.get(key, Any), f"{where}.{key}")
        if found is not None:
            return found
    return None


def _misfit_of_union(value: Any, choices: Sequence[Any], where: str) -> Misfit | None:
    found = []
    for choice in choices:
        one = misfit(value, choice, where)
        if one is None:
            return None
        found.append(one)
    deepest = max(found, key=lambda one: len(one.where))
    if deepest.where != where:  # the value is of this kind, and a part of it is wrong
        return deepest
    wanted = " or ".join(dict.fromkeys(one.wanted for one in found))
    return Misfit(where, wanted, found[0].got)


def _misfit_of_mapping(value: Mapping[Any, Any], hint: Any, where: str) -> Misfit | None:
    inner = typing.get_args(hint)
    keys = typing.get_args(inner[0]) if len(inner) == 2 and typing.get_origin(inner[0]) is Literal else value
    hints = dict.fromkeys(keys, inner[1] if len(inner) == 2 else Any)
    if typing.is_typeddict(hint):
        hints = typing.get_type_hints(hint, include_extras=True)
        missing = sorted(key for key in hint.__required_keys__ if key not in value)
        if missing:
            return Misfit(where, f"a mapping with {', '.join(missing)}", repr(dict(value)))
    elif hint is not Any and not _is_a(typing.get_origin(hint) or hint, Mapping):
        return Misfit(where, words_of(hint), repr(dict(value)))
    for key, one in value.items():
        if key not in hints:
            return Misfit(f"{where}.{key}", f"one of {', '.join(hints)}", None)
        found = misfit(one, hints[key], f"{where}.{key}")
        if found is not None:
            return found
    return None


def _misfit_of_sequence(value: Sequence[Any], hint: Any, where: str) -> Misfit | None:
    origin, inner = typing.get_origin(hint) or hint, typing.get_args(hint)
    if hint is not Any and (not _is_a(origin, Iterable) or _is_a(origin, Mapping)):
        return Misfit(where, words_of(hint), repr(list(value)))
    if origin is tuple and inner and inner[-1] is not Ellipsis:
        if len(inner) != len(value):
            return Misfit(where, f"a list of {len(inner)} values", repr(list(value)))
        hints = list(inner)
    else:
        hints = [inner[0] if inner else Any] * len(value)
    for number, (one, of) in enumerate(zip(value, hints, strict=True)):
        found = misfit(one, of, f"{where}[{number}]")
        if found is not None:
            return found
    return None


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a YAML scalar has a type."""
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if typing.get_origin(hint) is Literal:
        return any(type(value) is type(one) and value == one for one in typing.get_args(hint))
    if isinstance(value, bool):  # an int to Python, not to a user
        return hint is bool
    if hint is float:
        return isinstance(value, (int, float))
    kind = typing.get_origin(hint) or hint
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return False
    if isinstance(value, str) and issubclass(kind, Collection):  # a string is not a list of letters
        return kind is str
    return isinstance(value, type(None) if kind is None else kind)


def _misfit_of_markers(value: Any, markers: Sequence[Any], where: str) -> Misfit | None:
    """Check a value of the right type against the ranges that its markers declare."""
    ranges = [found for marker in markers if (found := _range_of(marker)) is not None]
    finite = not isinstance(value, float) or math.isfinite(value)
    if finite and all(holds(value) for _, holds in ranges):
        return None
    wanted = [words for words, _ in ranges]
    if not finite and not any(isinstance(marker, (Le, Lt)) for marker in markers):
        wanted.append("finite" if wanted else "a finite number")
    return Misfit(where, " and ".join(wanted), repr(list(value) if isinstance(value, tuple) else value))


def _range_of(marker: Any) -> tuple[str, Callable[[Any], bool]] | None:
    """Return a range in words, and whether a value lies in it; None for a marker that declares none."""
    match marker:
        case Ge(ge=bound):
            return f"at least {bound}", lambda value: value >= bound
        case Gt(gt=bound):
            return f"more than {bound}", lambda value: value > bound
        case Le(le=bound):
            return f"at most {bound}", lambda value: value <= bound
        case Lt(lt=bound):
            return f"less than {bound}", lambda value: value < bound
        case MultipleOf(multiple_of=bound):
            return f"a multiple of {bound}", lambda value: value % bound == 0
        case MinLen(min_length=bound):
            return f"{bound} or more values", lambda value: len(value) >= bound
        case MaxLen(max_length=bound):
            return f"at most {bound} values", lambda value: len(value) <= bound
        case Ascending(strictly=True):
            return "increasing values", lambda value: list(value) == sorted(set(value))
        case Ascending():
            return "values that do not decrease", lambda value: list(value) == sorted(value)
        case Distinct():
            return "no repeated value", lambda value: len(set(value)) == len(value)
        case Matching(test=test, wanted=wanted):
            return wanted, test
    return None


def _is_a(kind: Any, base: type) -> bool:
    return isinstance(kind, type) and issubclass(kind, base) and kind is not str


def _one_of(names: Iterable[Any]) -> str:
    listed = [str(name) for name in names]
    return listed[0] if len(listed) == 1 else f"one of {', '.join(listed)}"

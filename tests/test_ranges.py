"""Ranges that are declared in types are enforced, in Python and for YAML alike, in one line that names the key."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypedDict

import pytest
from annotated_types import Ge, Interval, MinLen, MultipleOf

from neural_sim.configuration import UserError
from neural_sim.ranges import (
    Ascending,
    Distinct,
    Matching,
    NonNegative,
    Positive,
    PositiveFraction,
    PositiveInt,
    check,
    validated,
)


class Bias(TypedDict, total=False):
    initial: Literal["uniform"] | Sequence[Positive]


@validated
@dataclass(frozen=True)
class Inner:
    radius: PositiveFraction | None = None


@validated
@dataclass(frozen=True)
class Settings:
    iterations: PositiveInt = 10
    start: Literal["fresh", "warm"] = "fresh"
    interval: Annotated[tuple[NonNegative, NonNegative], Ascending()] = (0.0, 1.0)
    names: Annotated[tuple[str, ...], MinLen(1), Distinct()] | None = None
    sizes: Sequence[Sequence[Positive]] = ()
    biased: Mapping[str, Bias] | None = None
    inner: Inner | None = None
    make: Callable[[], Any] | None = None
    patch: Annotated[int, Interval(ge=8, le=64), MultipleOf(8)] = 8
    odd: Annotated[int, Matching(lambda value: value % 2 == 1, "an odd number")] = 1
    weight: float = 1.0
    other: object = None
    whole: bool = True

    def __post_init__(self):
        if self.iterations > 100 and self.start == "warm":
            raise ValueError("want at most 100 iterations from a warm start")


@validated
class Plain:
    def __init__(self, bins: Annotated[int, Ge(2)], *, mode: str = "a", **others: float) -> None:
        self.bins = bins


HERE = f"{__name__}."
CASES = {
    "iterations=0": ({"iterations": 0}, "iterations: want at least 1, got 0"),
    "no whole number": ({"iterations": 1.5}, "iterations: want a whole number, got 1.5"),
    "true is no number": ({"iterations": True}, "iterations: want a whole number, got True"),
    "one is not true": ({"whole": 1}, "whole: want true or false, got 1"),
    "null": ({"iterations": None}, "iterations: want a whole number, got None"),
    "nan": ({"weight": math.nan}, "weight: want a finite number, got nan"),
    "inf": ({"sizes": [[math.inf]]}, "sizes[0][0]: want more than 0 and finite, got inf"),
    "nan in a union": ({"inner": Inner, "radius": math.nan}, None),
    "choice": ({"start": "cold"}, "start: want one of fresh, warm, got 'cold'"),
    "descending": ({"interval": [2, 1]}, "interval: want values that do not decrease, got [2, 1]"),
    "inside a tuple": ({"interval": (-1.0, 1.0)}, "interval[0]: want at least 0, got -1.0"),
    "one value of two": ({"interval": [1.0]}, "interval: want a list of 2 values, got [1.0]"),
    "no list": ({"interval": 1.0}, "interval: want a list of numbers, got 1.0"),
    "text is no list": ({"names": "can"}, "names: want a list of strings or null, got 'can'"),
    "empty": ({"names": []}, "names: want 1 or more values and no repeated value or null, got []"),
    "twice": (
        {"names": ["a", "a"]},
        "names: want 1 or more values and no repeated value or null, got ['a', 'a']",
    ),
    "in lists of lists": ({"sizes": [[1], [2, 0]]}, "sizes[1][1]: want more than 0, got 0"),
    "key of a dictionary": (
        {"biased": {"can": {"initail": "uniform"}}},
        "biased.can.initail: unknown key, want one of initial",
    ),
    "value of a dictionary": (
        {"biased": {"can": {"initial": [1.0, -1.0]}}},
        "biased.can.initial[1]: want more than 0, got -1.0",
    ),
    "choice of a union": (
        {"biased": {"can": {"initial": "unifrom"}}},
        "biased.can.initial: want uniform or a list of numbers, got 'unifrom'",
    ),
    "no mapping": ({"biased": ["can"]}, "biased: want a mapping or null, got ['can']"),
    "no object": ({"inner": 3}, "inner: want a group with a _target_, such as Inner or null, got 3"),
    "interval": ({"patch": 72}, "patch: want at least 8 and at most 64 and a multiple of 8, got 72"),
    "multiple": ({"patch": 9}, "patch: want at least 8 and at most 64 and a multiple of 8, got 9"),
    "test": ({"odd": 2}, "odd: want an odd number, got 2"),
}
del CASES["nan in a union"]


@pytest.mark.parametrize("name", CASES)
def test_python_and_yaml_refuse_the_same_in_the_same_words(name):
    values, message = CASES[name]
    with pytest.raises(UserError) as caught:
        Settings(**values)
    assert str(caught.value) == f"Settings.{message}"
    with pytest.raises(UserError) as caught:
        check({"_target_": HERE + "Settings", **values}, Any, "outer")
    assert str(caught.value) == f"outer.{message}"


def test_what_fits_is_taken():
    made = Settings(
        3,
        "warm",
        [0, 1.5],
        ["can"],
        [[1, 2.0], []],
        {"can": {"initial": [1]}},
        Inner(1),
        Inner,
        patch=64,
        other={"a": [1]},
    )
    assert made.interval == [0, 1.5] and made.inner == Inner(1)
    assert Settings(names=None, biased={"can": {}}) == Settings(biased={"can": {}})


def test_a_whole_key_is_named_at_every_depth():
    node = {"_target_": HERE + "Settings", "inner": {"_target_": HERE + "Inner", "radius": 2}}
    with pytest.raises(
        UserError, match=r"^outer\.inner\.radius: want more than 0 and at most 1 or null, got 2$"
    ):
        check(node, Any, "outer")
    node["inner"] = {"_target_": HERE + "Inner", "raduis": 1}
    with pytest.raises(UserError, match=r"^outer\.inner\.raduis: unknown key, want one of radius$"):
        check(node, Any, "outer")
    with pytest.raises(UserError, match=r"^list\[1\]\.radius: want "):
        check([{}, {"_target_": HERE + "Inner", "radius": 0}], Any, "list")


def test_lazily_built_objects_are_checked_by_their_signature():
    node = {"_target_": HERE + "Plain", "_partial_": True, "bins": 1}
    with pytest.raises(UserError, match=r"^detector\.bins: want at least 2, got 1$"):
        check(node, Any, "detector")
    check({**node, "bins": 2, "other": 0.5}, Any, "detector")
    with pytest.raises(UserError, match=r"^Plain\.bins: want at least 2, got 1$"):
        Plain(1)
    with pytest.raises(UserError, match=r"^Plain\.mode: want a string, got 3$"):
        Plain(2, mode=3)


def test_a_target_that_does_not_exist_is_refused():
    for wrong in ("neural_sim.ranges.Nothing", "nothing.at.all", "neural_sim..x"):
        with pytest.raises(UserError, match=r"^field\._target_: want the name of a class or function"):
            check({"_target_": wrong}, Any, "field")


def test_conditions_on_several_arguments_come_after_the_ranges():
    with pytest.raises(ValueError, match="at most 100 iterations"):
        Settings(iterations=101, start="warm")
    with pytest.raises(UserError, match=r"Settings\.iterations: want at least 1"):
        replace(Settings(start="warm"), iterations=0)

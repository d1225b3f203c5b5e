"""Types of settings as their source has them: the same that the classes have once imported, but known at once."""

import pkgutil
import re

import pytest

from neural_sim.configuration import UserError, conf_directory
from neural_sim.declared import check_early, declared
from neural_sim.ranges import Matching, hints_of

TARGETS = sorted(
    {
        name
        for path in conf_directory().rglob("*.yaml")
        for name in re.findall(r"_target_: (neural_sim\.[\w.]+)", path.read_text(encoding="utf-8"))
    }
)
NODE = {"_target_": "neural_sim.outer.settings.Outer", "iterations": 10}


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_read_is_what_is_declared(target):
    read, whole = declared(target), hints_of(pkgutil.resolve_name(target))
    for name, hint in read.items():
        if not any(isinstance(marker, Matching) for marker in getattr(hint, "__metadata__", ())):
            assert repr(hint).split("<lambda>")[0] == repr(whole[name]).split("<lambda>")[0], name


def test_most_settings_are_read():
    """Others are groups of their own, or have types from modules that are not read."""
    read = sum(len(declared(target)) for target in TARGETS)
    assert read > 0.6 * sum(len(hints_of(pkgutil.resolve_name(target))) for target in TARGETS)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({**NODE, "iterations": 0}, "outer.iterations: want at least 1, got 0"),
        ({**NODE, "iterations": "ten"}, "outer.iterations: want a whole number, got 'ten'"),
        ({"inner": {**NODE, "epochs": -1}}, "outer.inner.epochs: want at least 0, got -1"),
    ],
)
def test_a_value_out_of_its_range_is_refused(node, message):
    with pytest.raises(UserError, match=f"^{message}$"):
        check_early(node, "outer")


TOGETHER = [
    (
        "export",
        "ExportTask",
        {"width": 640, "height": None},
        "export.width: want width and height or neither, got 640 and",
    ),
    (
        "predict",
        "PredictTask",
        {"images": None},
        "predict.images: want a picture, a folder or a pattern in quotes, got N",
    ),
]


@pytest.mark.parametrize(("where", "name", "values", "message"), TOGETHER)
def test_rules_of_tasks_are_those_of_their_classes(where, name, values, message):
    """The same rule, whether its source is read or the class is made."""
    target = f"neural_sim.tasks.{where}.{name}"
    with pytest.raises(UserError, match=f"^{message}"):
        check_early({"_target_": target, **values}, where)
    with pytest.raises(UserError, match=f"^{message.replace(where, name, 1)}"):
        pkgutil.resolve_name(target)(**values)


def test_what_cannot_be_read_is_left_to_others():
    check_early({**NODE, "steps": 3, "no_such_setting": 1}, "outer")
    check_early({"_target_": "other.package.Class", "size": "large"}, "part")
    check_early("a word", "name")
    assert declared("neural_sim.outer.settings.Missing") == {}

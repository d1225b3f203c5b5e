"""What the configuration can make: its defaults are the constructors', and every declared range is enforced."""

import dataclasses
import inspect
import math
import pkgutil
import re
import types
import typing
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Union

import hydra
import pytest
from annotated_types import Ge, Gt, Le, Lt, MinLen
from composing import composed
from omegaconf import OmegaConf

from neural_sim.main import conf_directory
from neural_sim.ranges import Ascending, UserError, check, hints_of, parted

CONF = conf_directory()
# Experiments, scales and variants only override; the paper's numbers are data.
OVERRIDES = {"experiment", "scale", "variant", "hydra", "paper"}
# Classes whose ranges are still checked by hand, or that take no settings; the list only shrinks.
BY_HAND = (
    "neural_sim.main.", "neural_sim.outer.", "neural_sim.gradient.unrolled.", "neural_sim.studies.work_precision.",
)  # fmt: skip
# Values that conf/ leaves null although the class wants one, so that only who uses the class must give it.
GIVEN = {"neural_sim.tasks.predict.PredictTask": {"images": "photographs"}}
CHOICES = sorted(
    path.relative_to(CONF).with_suffix("").as_posix()
    for path in CONF.glob("*/**/*.yaml")
    if path.relative_to(CONF).parts[0] not in OVERRIDES
)


def _compositions():
    """The default configuration, then each choice of every group in it: with interpolations, and without."""
    base = composed("baseline=neural_sim_derivative")  # which sets nothing of the loop itself
    yield OmegaConf.to_container(base), OmegaConf.to_container(base, resolve=True)
    for choice in CHOICES:
        if "override /" in (CONF / f"{choice}.yaml").read_text():
            group = composed(choice.replace("/", "="))
            yield OmegaConf.to_container(group), OmegaConf.to_container(group, resolve=True)
            continue
        group = composed(file=choice)  # alone, which is much faster
        whole = {name: node for name, node in base.items_ex(resolve=False) if name not in group}
        made = OmegaConf.merge(whole, group)
        raw, plain = OmegaConf.to_container(made), OmegaConf.to_container(made, resolve=True)
        yield {name: raw[name] for name in group}, {name: plain[name] for name in group}


def nodes(raw, plain):
    """Every node with a ``_target_``, with its interpolations and without."""
    if isinstance(plain, dict):
        if "_target_" in plain:
            yield raw, plain
        for key in plain:
            yield from nodes(raw[key], plain[key])


def of_the_scale(raw):
    """Whether a value is a budget's, which every scale overwrites, or has to be given on the command line."""
    if isinstance(raw, dict):
        return any(of_the_scale(value) for value in raw.values())
    return isinstance(raw, str) and ("${budget." in raw or raw == "???")


def defaults(make):
    """The constructor's defaults by argument."""
    found = {
        name: parameter.default
        for name, parameter in inspect.signature(make).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    fields = dataclasses.fields(make) if dataclasses.is_dataclass(make) else ()
    made = {f.name: f.default_factory() for f in fields if f.default_factory is not dataclasses.MISSING}
    return found | {name: value for name, value in made.items() if name in found}


def as_lists(value):
    """A value with its sequences as lists and its dataclasses as mappings, which compare by what they hold."""
    if dataclasses.is_dataclass(value):
        held = {f.name: as_lists(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": type(value).__name__, **held}
    return [as_lists(item) for item in value] if isinstance(value, (list, tuple)) else value


@pytest.fixture(scope="module")
def compositions():
    return list(_compositions())


@pytest.fixture(scope="module")
def made(compositions):
    """A node of everything that the configuration can make, by its target."""
    found = {node["_target_"]: node for _, plain in compositions for _, node in nodes(plain, plain)}
    return {target: {**node, **GIVEN.get(target, {})} for target, node in found.items()}


def said(compositions):
    """(target, argument) -> all values that nodes of these compositions give it."""
    found = defaultdict(list)
    for raw, plain in compositions:
        for unresolved, node in nodes(raw, plain):
            for key, value in node.items():
                if key.startswith("_") or of_the_scale(unresolved[key]):
                    continue
                if isinstance(value, dict) and "_target_" in value:
                    value = hydra.utils.instantiate(value, _convert_="all")
                if (value := as_lists(value)) not in found[node["_target_"], key]:
                    found[node["_target_"], key].append(value)
    return found


def test_defaults_are_those_of_the_configuration(compositions):
    """A constructor's default is what the configuration says, so that code and command line mean the same by one name.
    Where several nodes give one argument different values, its default is one of them."""
    ours, others = said(compositions[:1]), said(compositions[1:])
    known = {target for target, _ in ours}
    values = ours | {key: value for key, value in others.items() if key[0] not in known}
    constructors = {target: defaults(pkgutil.resolve_name(target)) for target, _ in values}
    wrong = [
        f"{target}.{name}: the configuration says {' or '.join(map(repr, expected))}, the constructor "
        f"{constructors[target][name]!r}"
        for (target, name), expected in values.items()
        if name in constructors[target] and as_lists(constructors[target][name]) not in expected
    ]
    assert len(values) > 150 and not wrong, "\n".join(wrong)


def edges(hint):
    """Values at both sides of each edge of a declared range, and whether they lie in it."""
    bare, markers = parted(hint)
    origin, inner = typing.get_origin(bare), typing.get_args(bare)
    if origin is Literal:
        return [(value, True) for value in inner] + [("no such choice", False)]
    if origin in (Union, types.UnionType):
        kinds = [parted(one)[0] for one in inner]
        others = (str,) * (str in kinds) + (int, float) * (sum(kind in (int, float) for kind in kinds) > 1)
        found = [edge for one in inner for edge in edges(one)]
        return [(value, fits) for value, fits in found if fits or not isinstance(value, others)]
    if bare in (int, float):
        return list(_of_number(bare, markers))
    if typing.is_typeddict(bare):
        hints = typing.get_type_hints(bare, include_extras=True)
        inside = [({key: value}, fits) for key, one in hints.items() for value, fits in edges(one)]
        return [*inside, ({"no_such_key": 1}, False)]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return [({"a": value}, fits) for value, fits in edges(inner[1])] if len(inner) == 2 else []
    if isinstance(origin, type) and issubclass(origin, Iterable) and inner:
        return list(_of_list(origin, inner, markers))
    return []


def _of_number(kind, markers):
    def beside(bound, towards):
        return bound + towards if kind is int else math.nextafter(bound, towards * math.inf)

    for marker in markers:
        match marker:
            case Ge(ge=bound):
                yield from ((bound, True), (beside(bound, -1), False))
            case Gt(gt=bound):
                yield from ((beside(bound, 1), True), (bound, False))
            case Le(le=bound):
                yield from ((bound, True), (beside(bound, 1), False))
            case Lt(lt=bound):
                yield from ((beside(bound, -1), True), (bound, False))
    yield from (("text", False), (True, False))
    if kind is float:
        yield from ((math.nan, False), (math.inf, False), (-math.inf, False))


def _of_list(origin, inner, markers):
    fixed = origin is tuple and inner[-1] is not Ellipsis
    count = (
        len(inner)
        if fixed
        else max([1, *(marker.min_length for marker in markers if type(marker) is MinLen)])
    )
    equal = not any(isinstance(marker, Ascending) and marker.strictly for marker in markers)
    for value, fits in edges(inner[0]):
        if not fits or (equal and count == 1):
            yield [value] * count, fits
    if count > 1 or len(markers):
        yield [], not any(isinstance(marker, MinLen) for marker in markers) and not fixed
    if any(isinstance(marker, Ascending) for marker in markers):
        yield [2, 1], False


def test_every_declared_range_is_enforced_for_yaml_and_in_python(made):
    cases = [
        (target, name, value, fits)
        for target in made
        for name, hint in hints_of(pkgutil.resolve_name(target)).items()
        if name != "return"
        for value, fits in edges(hint)
    ]
    wrong = []
    for target, name, value, fits in cases:
        make = pkgutil.resolve_name(target)
        messages = [_refusal(lambda: check({**made[target], name: value}, Any, "group"))]  # noqa: B023
        if not fits and "__validated__" in vars(make):
            messages.append(_refusal(lambda: make(**{name: value})))  # noqa: B023
        keys = (f"group.{name}", f"{make.__name__}.{name}")
        if not all(bool(message.startswith(keys)) != fits for message in messages):
            wrong.append(f"{target}.{name}={value!r}, which {'fits' if fits else 'does not'}: {messages}")
    assert len(cases) > 300 and not wrong, "\n".join(wrong)


def _refusal(make):
    try:
        make()
    except UserError as error:
        return str(error)
    return ""


def test_every_class_that_the_configuration_makes_is_validated():
    text = "".join(path.read_text() for path in CONF.rglob("*.yaml"))
    targets = set(re.findall(r"_target_: (neural_sim\.[\w.]+)", text))
    bare = {target for target in targets if not hasattr(pkgutil.resolve_name(target), "__validated__")}
    assert len(targets) > 60 and not {target for target in bare if not target.startswith(BY_HAND)}


def test_no_node_takes_an_unknown_key(made):
    for node in made.values():
        with pytest.raises(UserError, match=r"^group\.no_such_key: unknown key, want "):
            check({**node, "no_such_key": 1}, Any, "group")

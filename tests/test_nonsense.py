"""Nonsense in every key of the configuration: refused in one line that names the group and a key of it, or taken."""

import copy
import itertools
from collections.abc import Iterator
from typing import Any

import pytest
from composing import composed
from PIL import Image

from neural_sim.main import _instantiate, _plain
from neural_sim.ranges import UserError

FAST = 13
"""One in this many of all pairs of a key and a value in every run; a prime, so that all values come."""
VALUES: tuple[Any, ...] = (
    float("nan"), float("inf"), -float("inf"), -1, 0, 1e300, -0.5, 10**30, "abc", "", "nan", [], {}, None, True, 2.5,
    [float("nan")], [[]], {"a": 1}, {"_target_": "os.getcwd"}, {"_target_": 3}, {"_target_": "abc"},
)  # fmt: skip


@pytest.fixture(scope="module")
def groups(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The default configuration's groups, with all parameters and a picture for what wants one."""
    picture = tmp_path_factory.mktemp("pictures") / "a.png"
    Image.new("RGB", (4, 4)).save(picture)
    plain = _plain(composed("parameter=[pose,zoom,illumination]", f"predict.images={picture}"))
    found = {key: node for key, node in plain.items() if isinstance(node, dict) and "_target_" in node}
    return found | {f"parameter.{name}": node for name, node in plain["parameter"].items()}


def places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in inner:
        if key != "_partial_":
            yield (*path, key)
            yield from places(value, (*path, key))


def refusal(group: str, node: Any, path: tuple[Any, ...], value: Any) -> str | None:
    """What is said of the group with a value in a place; None where it is made."""
    made = copy.deepcopy(node)
    at = made
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = copy.deepcopy(value)
    keys = {str(key) for part in (at, node) if isinstance(part, dict) for key in part} | set(map(str, path))
    try:
        _instantiate(made, group)
    except UserError as error:
        said = str(error)
        assert "\n" not in said and said.startswith(group), f"{group} {path} {value!r}: {said}"
        assert any(key in said for key in keys), f"{group} {path} {value!r}: {said}"
        return said
    return None


def run(groups: dict[str, Any], every: int) -> tuple[int, int]:
    pairs = [
        (group, node, path, value)
        for group, node in groups.items() for path, value in itertools.product(places(node), VALUES)
    ]  # fmt: skip
    refused = [refusal(*pair) for pair in pairs[::every]]
    return len(refused), sum(said is not None for said in refused)


@pytest.mark.filterwarnings("ignore")
def test_nonsense_is_refused_by_its_key(groups):
    count, refused = run(groups, FAST)
    assert count > 400 and refused > 0.7 * count


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_all_nonsense_is_refused_by_its_key(groups):
    count, refused = run(groups, 1)
    print(f"{count} configurations, {refused} refused")
    assert count > 5000 and refused > 0.7 * count


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_are_not_finite_are_never_taken(groups, value):
    for group, node in groups.items():
        for path in places(node):
            if path[-1] != "_target_":
                assert refusal(group, node, path, value) is not None, (group, path)

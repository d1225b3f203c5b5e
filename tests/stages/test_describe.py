"""Descriptions of settings are equal for equal settings, and for no others."""

import functools
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import pytest
import torch

from neural_sim.digests import digest, tensor_digest
from neural_sim.stages.describe import describe, modules_of


@dataclass(frozen=True)
class Settings:
    rate: float
    names: tuple[str, ...] = ()


class Plain:
    def __init__(self, size, scale=2):
        self.size, self.scale, self.cache = size, scale, object()


class Source:
    def __init__(self, root):
        self._root = root

    def digest(self):
        return f"contents of {self._root}"


def test_settings_are_described_by_what_they_were_constructed_with():
    assert describe(Settings(0.1, ("a",))) == {"class": f"{__name__}:Settings", "rate": 0.1, "names": ["a"]}
    assert describe(Plain(3)) == {"class": f"{__name__}:Plain", "size": 3, "scale": 2}
    assert describe(Source("x")) == {"class": f"{__name__}:Source", "digest": "contents of x"}
    made = describe(functools.partial(Settings, rate=0.1))
    assert made == {"call": f"{__name__}:Settings", "with": [{"rate": 0.1}]}
    assert describe({"a": [None, True, Path("b")]}) == {"a": [None, True, "b"]}


@pytest.mark.parametrize("thing", [object(), Fraction(1, 2), {1, 2}])
def test_what_cannot_be_described_is_refused(thing):
    with pytest.raises(TypeError, match="cannot describe"):
        describe(thing)


def test_the_modules_of_all_classes_are_named():
    tree = describe([Settings(0.1), {"inner": functools.partial(Plain, 1)}, torch.nn.Identity])
    assert set(modules_of(tree)) == {__name__, "torch.nn.modules.linear"}


def test_digests_ignore_the_order_of_keys_and_refuse_objects():
    assert digest({"a": 1, "b": [1, 2]}) == digest({"b": [1, 2], "a": 1})
    assert digest({"a": 1}) != digest({"a": 1.5})
    with pytest.raises(TypeError):
        digest({"a": object()})


def test_tensor_digest_sees_values_shapes_and_types():
    x = torch.arange(4.0)
    assert tensor_digest([x]) == tensor_digest([x.clone()])
    seen = {tensor_digest([y]) for y in (x, x.double(), x.reshape(2, 2), x + 1)}
    assert len(seen) == 4

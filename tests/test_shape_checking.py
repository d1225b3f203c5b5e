"""Tests run with arrays checked: what has another shape than its annotation says is refused, on the way in and out."""

import dataclasses
import inspect
import typing

import beartype.roar
import pytest
import torch
from jaxtyping import Float
from shape_checking import checked, jaxtyped
from torch import Tensor

from neural_sim.cameras import orbit
from neural_sim.parameter.distributions import total_variation
from neural_sim.types import Maps

Refused = beartype.roar.BeartypeCallHintViolation


def test_the_package_is_checked():
    with pytest.raises(Refused):
        total_variation(torch.ones(2, 3), torch.ones(2, 4))
    with pytest.raises(Refused):
        orbit(torch.zeros(3), torch.zeros(2), torch.ones(3))
    with pytest.raises(Refused):
        Maps(torch.zeros(1, 4, 5, 3), torch.zeros(1, 5, 4))
    assert total_variation(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0])) == 1.0


def test_a_dimension_is_one_number_within_a_call_and_free_in_the_next():
    @checked
    def joined(a: Float[Tensor, "n 2"], b: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        return torch.cat([a, b[:, None]], 1)

    assert joined(torch.zeros(4, 2), torch.zeros(4)).shape == (4, 3)
    assert joined(torch.zeros(5, 2), torch.zeros(5)).shape == (5, 3)
    with pytest.raises(Refused):
        joined(torch.zeros(4, 2), torch.zeros(5))

    with pytest.raises(Refused):  # again, after calls that were right
        joined(torch.zeros(5, 2), b=torch.zeros(4))
    with pytest.raises(Refused):
        joined(torch.zeros(4, 2).long(), torch.zeros(4))
    assert joined(b=torch.zeros(4), a=torch.zeros(4, 2)).shape == (4, 3)

    @checked
    def wrong(a: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        return torch.cat([a, a])

    with pytest.raises(Refused):
        wrong(torch.zeros(3))

    answers = [torch.zeros(3), torch.zeros(3), torch.zeros(4)]

    @checked
    def wrong_at_last(a: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        return answers.pop(0)

    assert len(wrong_at_last(torch.zeros(3))) == len(wrong_at_last(torch.zeros(3))) == 3
    with pytest.raises(Refused):  # from the same shapes
        wrong_at_last(torch.zeros(3))
    assert not answers  # each call calls once


def test_what_has_no_arrays_stays_as_it_is_and_annotations_too():
    def plain(a: int, b: str = "x") -> int:
        return a

    def mixed(a: int, x: Float[Tensor, "n"] | None = None, *, k: "int" = 3) -> int:
        return a + k

    assert checked(plain) is plain
    assert typing.get_type_hints(checked(mixed)) == typing.get_type_hints(mixed)
    assert inspect.signature(checked(mixed)) == inspect.signature(mixed) and checked(mixed)("a" * 0 or 1) == 4


def test_arrays_inside_of_others_are_checked_at_every_call():
    @checked
    def total(parts: dict[str, Float[Tensor, "n"]], *more: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        return sum(parts.values()) + sum(more)

    assert len(total({"a": torch.ones(2)}, torch.ones(2))) == 2
    with pytest.raises(Refused):
        total({"a": torch.ones(2)}, torch.ones(3, 1))

    @checked
    def count(*parts: Float[Tensor, "n"]) -> int:
        return len(parts)

    assert count(torch.ones(2), torch.ones(2)) == 2
    with pytest.raises(Refused):
        count(torch.ones(2), torch.ones(3))


def test_constructors_of_dataclasses_are_checked():
    @jaxtyped(typechecker=None)
    @dataclasses.dataclass(frozen=True)
    class Pair:
        a: Float[Tensor, "n"]
        b: Float[Tensor, "n"]

    assert len(Pair(torch.zeros(2), torch.zeros(2)).a) == 2
    with pytest.raises(Refused):
        Pair(torch.zeros(2), torch.zeros(3))


def test_a_test_may_pass_wrong_shapes(wrong_shapes):
    with pytest.raises(RuntimeError):
        total_variation(torch.ones(2, 3), torch.ones(2, 4))

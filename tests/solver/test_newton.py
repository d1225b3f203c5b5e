"""The minimiser on functions whose minima are known, from starts where the Hessian is indefinite."""

import pytest
import torch
from newton import minimise

DOUBLE = torch.float64


def point(*values):
    return {"x": torch.tensor(values, dtype=DOUBLE)}


def test_a_quadratic_is_solved(symmetric, spread, right_hand_side):
    matrix, b = symmetric(spread(1e3)), right_hand_side()
    terms = [lambda p: 0.5 * p["x"] @ matrix @ p["x"], lambda p: -(b @ p["x"])]
    found = minimise(terms, {"x": torch.zeros_like(b)}, 1e-10)
    assert found.converged and found.slope <= 1e-10
    torch.testing.assert_close(found.params["x"], torch.linalg.solve(matrix, b), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.0, 1.0), (3.0, -7.0)])
def test_rosenbrocks_valley(start):
    """At (0, 1) its Hessian has the eigenvalue -398."""
    terms = [lambda p: 100.0 * (p["x"][1] - p["x"][0] ** 2) ** 2, lambda p: (1.0 - p["x"][0]) ** 2]
    found = minimise(terms, point(*start), 1e-10)
    assert found.converged and found.slope <= 1e-10 and found.products > found.steps
    torch.testing.assert_close(found.params["x"], torch.ones(2, dtype=DOUBLE), rtol=1e-9, atol=1e-9)


def test_it_leaves_a_maximum_whose_hessian_is_negative_definite():
    found = minimise([lambda p: torch.cos(p["x"]).sum()], point(0.1, -0.2), 1e-10)
    assert found.converged and found.value == pytest.approx(-2.0)


def test_the_start_stays_as_it_is_and_a_minimum_costs_nothing():
    start = point(1.0, 1.0)
    found = minimise([lambda p: (p["x"] - 1.0).square().sum()], start, 1e-12)
    assert found.converged and found.steps == found.products == 0
    moved = minimise([lambda p: (p["x"] - 5.0).square().sum()], start, 1e-12)
    assert moved.params["x"].tolist() == pytest.approx([5.0, 5.0]) and start["x"].tolist() == [1.0, 1.0]
    assert not moved.params["x"].requires_grad


def test_what_does_not_converge_says_so():
    spent = minimise([lambda p: (p["x"] ** 4).sum()], point(5.0), 1e-12, max_steps=3)
    assert not spent.converged and spent.steps == 3 and spent.slope > 1e-12
    beyond_rounding = minimise([lambda p: (p["x"] - 1e8).square().sum() + 1e20], point(0.0, 3.0), 1e-300)
    assert beyond_rounding.steps < 50 and beyond_rounding.converged == (beyond_rounding.slope <= 1e-300)
    endless = minimise([lambda p: p["x"].sum()], point(0.0), 1e-6, max_steps=5)
    assert not endless.converged
    with pytest.raises(ValueError, match="tolerance"):
        minimise([lambda p: p["x"].sum()], point(0.0), 0.0)

"""Observed orders of the quadrature are those of theory, against references that closed forms confirm."""

import math

import pytest
import torch

from neural_sim.studies.work_precision import quadrature
from neural_sim.studies.work_precision.measurement import Timing
from neural_sim.studies.work_precision.quadrature import DENSITIES, SPAN, Quadrature, box, reference

OFFSET = torch.rand(64, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def test_the_references_opacity_is_the_closed_form():
    """Optical depths: sqrt(pi)/2 0.7 3 (erf - erf) of the blob, density times thickness of a box."""
    far, near = (SPAN - 0.9 - 0.2 * OFFSET) / 0.7, (-0.9 - 0.2 * OFFSET) / 0.7
    depth = 3.0 * 0.7 * math.sqrt(math.pi) / 2.0 * (torch.erf(far) - torch.erf(near))
    found = reference(DENSITIES["smooth"], OFFSET, 4096)[:, 3]
    # Second order: h^2 / 24 times the difference of the slopes at both ends, which are at most 3 / 0.7 sqrt(2 / e).
    bound = (SPAN / 4096) ** 2 / 24.0 * 2.0 * 3.0 / 0.7 * math.sqrt(2.0 / math.e)
    assert float((found + torch.expm1(-depth)).abs().max()) < 1.1 * bound
    for name, thickness in (("sharp", quadrature.WIDE), ("thin", quadrature.THICKNESS)):
        begin, end = box(thickness, OFFSET)
        density = quadrature.DEPTH / thickness
        found = reference(DENSITIES[name], OFFSET, 16384)[:, 3]
        # The sum counts whole cells: less than one too many or too few.
        assert float((found + torch.expm1(-density * (end - begin))).abs().max()) < density * SPAN / 16384


@pytest.fixture(scope="module")
def measured():
    return {s.name.partition("/")[2]: s for s in Quadrature(rays=512).measure(None, Timing(1), seed=0)}


# A slope through 4 (thin: 3) errors, each the root mean square of 512 rays that varies by about 1/sqrt(2 512) = 3 %:
# below 0.03 sqrt(2) / ln 4 = 0.03 for independent ones. Errors of a jump are of the order of the step itself, and of
# relative size h / thickness, up to 0.5 for the thin shell: there the next order is not small yet.
@pytest.mark.parametrize(("name", "within"), [("smooth", 0.1), ("sharp", 0.1), ("thin", 0.25)])
@pytest.mark.parametrize("kind", ["opacity", "colour"])
def test_observed_orders_are_those_of_theory(measured, name, kind, within):
    orders = {order.line: order for order in measured[f"{name}, {kind}"].orders}
    assert (orders["midpoint"].theory, orders["jittered"].theory) == {
        "smooth": (2.0, 1.5), "sharp": (1.0, 1.0), "thin": (1.0, 1.0)
    }[name]  # fmt: skip
    for order in orders.values():
        assert order.observed == pytest.approx(order.theory, abs=within)


def test_a_shell_thinner_than_the_step_is_not_resolved(measured):
    errors = {point.setting: point.error for point in measured["thin, opacity"].points}
    # At 16 samples it is missed 8 times of 9: the error is nearly its whole opacity, 1 - exp(-1) on average.
    assert errors["midpoint, 16"] > 0.5 and errors["midpoint, 1024"] < 0.05


def test_the_default_is_measured_and_marked(measured):
    for series in measured.values():
        assert [point.setting for point in series.points if point.default] == ["midpoint, 128"]
    odd = next(iter(Quadrature((8, 16), default=12, rays=4).measure(None, Timing(1), 0)))
    assert [p.setting for p in odd.points if p.line == "midpoint"] == [
        "midpoint, 8",
        "midpoint, 12",
        "midpoint, 16",
    ]


def test_a_wrong_rule_would_be_seen(monkeypatch):
    """Densities of the interval before are of first order for a smooth density too."""
    original = quadrature.composite

    def early(sigma, rgb, samples):
        of_rays = sigma.view(len(samples.starts) - 1, -1)
        return original(torch.cat([of_rays[:, :1], of_rays[:, :-1]], 1).reshape(-1), rgb, samples)

    monkeypatch.setattr(quadrature, "composite", early)
    monkeypatch.setattr(quadrature, "reference", lambda density, offset, samples: _exact(density, offset))
    series = next(iter(Quadrature((32, 64, 128, 256), rays=64).measure(None, Timing(1), 0)))
    assert series.orders[0].observed < 1.5


def _exact(density, offset):
    distance = (torch.arange(8192, dtype=torch.float64) + 0.5) * SPAN / 8192
    along = distance.expand(len(offset), -1)
    depth = density.sigma(along, offset[:, None].expand_as(along)).sum(1) * SPAN / 8192
    return torch.cat([torch.zeros(len(offset), 3, dtype=torch.float64), -torch.expm1(-depth)[:, None]], -1)


def test_bad_settings_name_their_key():
    with pytest.raises(ValueError, match=r"Quadrature\.samples"):
        Quadrature(samples=(64, 32))
    with pytest.raises(ValueError, match=r"Quadrature\.rays: want at least 2"):
        Quadrature(rays=1)

"""Distributions by name, and what is refused."""

import pytest
import torch

from neural_sim.parameter.distributions import distribution, merged, total_variation


def test_dominant_is_the_papers():
    p = distribution({"dominant": 3}, 8)
    assert p[2].item() == pytest.approx(0.86)
    assert p[[0, 1, 3, 4, 5, 6, 7]].tolist() == pytest.approx([0.02] * 7)


def test_modes_share_the_rest_equally():
    p = distribution({"modes": [1, 6]}, 8)
    assert p[0] == p[5] and p[0].item() == pytest.approx(0.44)
    assert p.sum().item() == pytest.approx(1.0)


@pytest.mark.parametrize("bins", [1, 2, 64])
def test_every_count_of_bins_gives_a_distribution(bins):
    for specification in ("uniform", {"dominant": 1}):
        p = distribution(specification, bins)
        assert p.sum().item() == pytest.approx(1.0) and (p > 0).all()


@pytest.mark.parametrize(
    "bad", ["gaussian", {"dominant": 0}, {"dominant": 9}, {"dominant": True}, {"modes": []}, {"modes": [1, 1]},
            [0.5, 0.5], [0.2] * 8, [-0.1, 0.3] + [0.8 / 6] * 6, [float("nan")] * 8, 3]
)  # fmt: skip
def test_bad_specifications_are_refused_with_their_place(bad):
    with pytest.raises(ValueError, match="here"):
        distribution(bad, 8, "here")


def test_bins_that_are_one_count_together():
    p = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.25, 0.25, 0.25, 0.25]])
    torch.testing.assert_close(
        merged(p, [[1, 4], [2], [3]]), torch.tensor([[0.5, 0.2, 0.3], [0.5, 0.25, 0.25]])
    )
    assert torch.equal(merged(p, [[1], [2], [3], [4]]), p)


def test_total_variation():
    p, q = torch.tensor([0.5, 0.5, 0.0]), torch.tensor([0.0, 0.5, 0.5])
    assert total_variation(p, q).item() == pytest.approx(0.5)
    assert total_variation(p, p).item() == 0.0

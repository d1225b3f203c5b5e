"""The derivative through a training on drawn images and photographs, against central differences of that training."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from recorded_training import DOUBLE, EXACT, STEP, Micro, extrapolated

from neural_sim.gradient.base import ObjectImages, Probes
from neural_sim.gradient.estimators import StratifiedEstimator
from neural_sim.gradient.reversal import RecordedTraining
from neural_sim.gradient.unrolled import ProbeGroups, Unrolled
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import SceneDistribution
from neural_sim.types import SceneDraw

BINS = torch.tensor([0, 1, 2, 0, 1, 2])  # of images 0 to 5; 6 and 7 are photographs
DISTRIBUTION = SceneDistribution.of([Pose(bins=3, floor=0.0)])
PSI = torch.tensor([0.3, -0.2, 0.1], dtype=DOUBLE)


class Mixed(Micro):
    """The micro training on all drawn images, and in turn on two, one or no photographs, in every batch."""

    def __init__(self, proximal=0.0):
        super().__init__(proximal)
        drawn = torch.arange(6)
        photographs = ([6, 7], [6], [7], [6, 7], [7, 7, 6], [])
        self.rows = tuple(torch.cat([drawn, torch.tensor(own, dtype=torch.long)]) for own in photographs)
        self.examples = dataclasses.replace(self.examples, drawn=6)

    def trained_at(self, psi):
        """The training whose drawn images have the weights p_b / n_b times their number, that is on average over draws
        from p_psi; photographs have weight 1."""
        weights = torch.ones(8, dtype=DOUBLE)
        p = DISTRIBUTION.factors[0].log_probabilities(psi).exp()
        weights[:6] = 6 * (p / torch.bincount(BINS))[BINS]
        examples = self.weighted(weights)
        return examples, self.trained(examples)


def images_of_object(psi):
    zero = torch.zeros(6, dtype=DOUBLE)
    return ObjectImages(
        psi, DISTRIBUTION, torch.zeros(6, 3, 1, 1), torch.arange(6), torch.full((6,), 1 / 6, dtype=DOUBLE),
        SceneDraw(zero, zero, zero, BINS[:, None]),
    )  # fmt: skip


@pytest.mark.parametrize("proximal", [0.0, 0.5])
def test_the_stratified_derivative_counts_photographs_in_the_training_alone(proximal):
    """Probes are the drawn images themselves, so that their mean scores are exact."""
    problem = Mixed(proximal)
    examples, made = problem.trained_at(PSI)
    examples = dataclasses.replace(examples, drawn=6)
    order = BINS.argsort(stable=True).view(3, 2)
    how = dataclasses.replace(EXACT, probes_per_step=0)
    sums = how.accumulate(
        RecordedTraining(made, examples, problem.like), problem.slope(made.end), torch.Generator(), "probes",
        ProbeGroups(problem.cached.losses, [order]),
    )  # fmt: skip
    probes = {"pose": Probes(order.flatten(), BINS[order.flatten()])}
    found = StratifiedEstimator(2).accumulated(sums, images_of_object(PSI), probes).value
    for direction in torch.eye(3, dtype=DOUBLE):

        def outcome(step, direction=direction):
            return problem.outer(problem.trained_at(PSI + step * direction)[1].end)

        difference = extrapolated(outcome, STEP)
        assert float(found @ direction) == pytest.approx(difference, rel=1e-6, abs=1e-6 * float(found.norm()))


def test_the_derivative_by_the_weights_of_drawn_images_is_that_of_the_same_training(generator):
    problem = Mixed()
    direction = torch.cat([torch.randn(6, generator=generator, dtype=DOUBLE), torch.zeros(2, dtype=DOUBLE)])
    found = float(problem.accumulated().images @ direction)

    def outcome(step):
        return problem.outer(problem.trained(problem.weighted(1.0 + step * direction)).end)

    # Some entries' gradients are smaller here than in the batches that STEP is for, and AdamW bends within them.
    assert found == pytest.approx(extrapolated(outcome, STEP / 100), rel=1e-6)


def test_forward_differences_stand_for_exact_products():
    """As without photographs, the order eps^(1/2) times second derivatives a step."""
    problem = Mixed(0.5)
    probes = ProbeGroups(problem.cached.losses, [BINS.argsort(stable=True).view(3, 2)])
    settings = {"probes_per_step": 0, "scored_steps": 0}
    exact, near = (
        problem.accumulated(Unrolled(product=product, **settings), probes=probes, wanted="probes").probes
        for product in ("reverse_over_reverse", "forward_difference")
    )
    assert float((near - exact).norm()) < 1e-5 * float(exact.norm())


def test_the_drawn_part_of_a_batch():
    examples = Mixed().examples
    assert [float(examples.drawn_part(rows)) for rows in Mixed().rows[:2]] == pytest.approx([6 / 8, 6 / 7])
    assert Micro().examples.drawn_part(torch.arange(3)) == 1.0

"""What becomes of a psi step by its certificate, in a loop that runs."""

import dataclasses

import pytest
import torch
from small_loop import MICRO, small_loop

from neural_sim.gradient.base import MixedDerivative
from neural_sim.gradient.estimators import ReinforceEstimator, StratifiedEstimator
from neural_sim.gradient.implicit import Implicit
from neural_sim.outer.certificate import Trust
from neural_sim.outer.loop import learn_psi
from neural_sim.parameter.pose import Pose
from neural_sim.parameter.product import HARD, SceneDistribution
from neural_sim.parameter.zoom import Zoom
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping

PROXIMAL = 20.0  # past the negative curvature of an untrained detector
NOTHING_WILL_DO = Implicit(curvature_images=6, max_residual=0.0)


@pytest.mark.parametrize("action", ["skip", "shrink", "keep"])
def test_untrusted_steps_are_skipped_shrunk_or_kept(scene, action):
    estimator = StratifiedEstimator(probes_per_bin=2)
    learned = learn_psi(
        small_loop(
            scene, estimator, 2, detector=MICRO, adjoint=NOTHING_WILL_DO, trust=Trust(on_untrusted=action)
        )
    )
    assert all(record.certificate.doubts == ["residual"] for record in learned.records)
    assert len(learned.records) == 2
    if action == "skip":
        assert not learned.last.any()
        return
    settings = {"adjoint": NOTHING_WILL_DO, "trust": Trust(on_untrusted=action)}
    one = learn_psi(small_loop(scene, estimator, 1, detector=MICRO, **settings)).last
    free = learn_psi(small_loop(scene, estimator, 1, detector=MICRO, trust=Trust(level=None))).last
    torch.testing.assert_close(one, (0.25 if action == "shrink" else 1.0) * free)


@dataclasses.dataclass(frozen=True)
class Told:
    """A derivative with p-values made up: object a has a signal in the poses, b in the zooms of the first iteration."""

    draws = HARD
    probes_per_bin = 0

    def estimate(self, losses, params, vector, images, probes):
        value = torch.tensor([1.0, -1.0, 0.0, 0.5, -0.5])
        first = int(images.index[0]) == 0
        return MixedDerivative(
            value, 0.1 * value.abs(), {"pose": 0.01 if first else 0.5, "zoom": 0.5 if first else 0.01}
        )


@pytest.mark.parametrize(("on_untrusted", "part"), [("shrink", 0.25), ("skip", 0.0)])
def test_a_step_without_signal_is_cut_for_its_object_and_factor_alone(scene, on_untrusted, part):
    scene = dataclasses.replace(scene, distribution=SceneDistribution.of([Pose(bins=3), Zoom(bins=2)]))
    psi = torch.zeros(2, 5)
    free, cut = (
        learn_psi(small_loop(scene, Told(), 2, detector=MICRO, psi=psi, **settings))
        for settings in ({"trust": Trust(level=None)}, {"trust": Trust(on_untrusted=on_untrusted)})
    )
    assert [record.certificate.doubts for record in cut.records] == [[], []]
    # The first step is free's, or a part of it; in the second psi, and with it the mirror's step, differ.
    parts = torch.tensor([[1.0] * 3 + [part] * 2, [part] * 3 + [1.0] * 2], dtype=torch.float64)
    assert bool((free.trajectory[1].abs().amax(0)[[0, 1, 3, 4]] > 0.0).all())
    torch.testing.assert_close(cut.trajectory[1], parts * free.trajectory[1])
    again = cut.trajectory[2] - cut.trajectory[1]
    assert bool(again.abs()[parts == 1.0].amax() > 0.0) and (part > 0.0 or not again[parts == 0.0].any())


@pytest.mark.parametrize(
    "estimator",
    [StratifiedEstimator(probes_per_bin=2), pytest.param(ReinforceEstimator(), marks=pytest.mark.slow)],
    ids=lambda e: type(e).__name__,
)
def test_a_step_is_certified_by_the_response_without_changing_the_run(scene, estimator):
    plain, certified = (
        learn_psi(small_loop(scene, estimator, 2, detector=MICRO, certify_every=every)) for every in (0, 2)
    )
    first, second = (record.certificate for record in certified.records)
    assert first.cosine is None and -1.0 <= second.cosine <= 1.0
    assert certified.records[1].seconds["certify"] > 0.0
    assert plain.records[1].probabilities == certified.records[1].probabilities
    assert plain.records[1].certificate.adjoint.solver_residual == second.adjoint.solver_residual


def test_the_proximal_problem_runs_in_the_loop(scene):
    solver = AdjointSolver(ConjugateGradient(), FixedDamping(0.0))
    module = small_loop(
        scene,
        StratifiedEstimator(probes_per_bin=2),
        1,
        solver,
        {**MICRO, "proximal": PROXIMAL},
        learning_rate=0.0,
    )
    certificate = learn_psi(module).records[0].certificate
    adjoint = certificate.adjoint
    assert adjoint.solver_status == "CONVERGED" and adjoint.damping == 0.0

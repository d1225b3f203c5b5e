"""The implicit hypergradient of a detector against the dense oracle and against finite differences of retraining."""

import pytest
import torch
from retrained import BinnedProblem, contrasts, finite_difference

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.gradient.base import Probes
from neural_sim.gradient.implicit import hypergradient
from neural_sim.outer.response import centred_cosine
from neural_sim.solver.adjoint import AdjointSolver
from neural_sim.solver.base import Status
from neural_sim.solver.cg import ConjugateGradient
from neural_sim.solver.damping import FixedDamping
from neural_sim.solver.direct import Exact
from neural_sim.types import LabelledImages

DOUBLE = torch.float64
BINS, PROXIMAL = 3, 1.0
PSI = torch.tensor([[0.3, -0.5, 0.2], [0.0, 0.9, -0.4]], dtype=DOUBLE)


def log_probabilities(psi):
    return torch.log_softmax(psi, -1)


def stripes(labels, bins, generator):
    """A square of stripes on noise: the object sets the colour, the bin the stripes' width and the square's size."""
    side, where = 10 + 4 * bins, torch.randint(1, 9, (len(bins), 2), generator=generator)
    images, boxes = 0.3 * torch.rand(len(bins), 3, 32, 32, generator=generator), []
    for image, label, b, s, (x, y) in zip(images, labels, bins, side, where, strict=True):
        pattern = ((torch.arange(s) // (b + 1)) % 2).float().expand(s, s)
        image[int(label) * 2, y : y + s, x : x + s] = 0.3 + 0.7 * pattern
        boxes.append([[x, y, x + s, y + s]])
    return LabelledImages(images, torch.tensor(boxes, dtype=torch.float32), labels[:, None], bins)


@pytest.fixture(scope="module")
def problem():
    """Two objects, three bins, the head of a micro detector trained to stationarity; one image a bin and object."""
    generator = torch.Generator().manual_seed(0)
    detector = RetinaNet(2, 32, Backbone("micro"), Head(8, 1), Anchors((8,), ((16,),), 32))
    params = detector.init(generator)
    backbone, trainable = detector.split(params)
    fixed = {name: value.double() for name, value in trainable.items() if not name.startswith("head.")}
    head = {name: value.double() for name, value in trainable.items() if name.startswith("head.")}
    labels, bins = torch.arange(2).repeat_interleave(BINS), torch.arange(BINS).repeat(2)
    held, validation = (
        CachedSet.of(detector, backbone, stripes(labels, bins, generator)).double() for _ in range(2)
    )
    problem = BinnedProblem(
        lambda head, rows: held.losses({**fixed, **head}, rows),
        [Probes(torch.arange(BINS) + label * BINS, torch.arange(BINS)) for label in range(2)],
        log_probabilities, PROXIMAL, head,
    )  # fmt: skip
    terms = [lambda head: validation.losses({**fixed, **head}, torch.tensor([0, 1, 5])).mean()]
    return problem, terms, problem.retrain(PSI, head, 1e-10)


@pytest.fixture(scope="module")
def oracle(problem):
    return implicit(problem, Exact(), 1e-12, 1)


def implicit(problem, linear, rtol, max_steps):
    binned, terms, minimum = problem
    estimates = {str(label): binned.estimate(PSI, label, minimum.params) for label in range(2)}
    solver = AdjointSolver(linear, FixedDamping(0.0, 0), rtol=rtol, max_steps=max_steps)
    inner = binned.at(PSI, minimum.params)
    return hypergradient(inner, terms, estimates, solver, torch.Generator().manual_seed(0))


def test_retraining_ends_at_a_stationary_point(problem):
    _, _, minimum = problem
    assert minimum.converged and minimum.slope < 1e-10


def test_the_oracle_is_the_retrained_derivative(problem, oracle):
    binned, terms, minimum = problem
    assert oracle.adjoint.stationarity < 1e-9 and oracle.adjoint.solution.residual < 1e-12
    found = finite_difference(binned, terms, PSI, 0, minimum.params, step=1e-2, tolerance=1e-10)
    assert found.converged and found.trainings == 2 * (BINS - 1)
    exact = oracle.gradients["0"]
    # step^2 / 6 of a third derivative of order one, in logits
    assert (found.gradient - exact).norm() < 1e-3 * exact.norm()
    assert centred_cosine(found.gradient, exact) > 1 - 1e-6


def test_conjugate_gradients_reach_the_oracle_inside_40_products(problem, oracle):
    found = implicit(problem, ConjugateGradient(), 1e-2, 40)
    assert found.adjoint.solution.status is Status.CONVERGED and found.adjoint.solution.products <= 40
    exact, close = (torch.cat(list(h.gradients.values())) for h in (oracle, found))
    assert (close - exact).norm() < 1e-2 * exact.norm()
    tight = implicit(problem, ConjugateGradient(), 1e-11, 400)
    assert (torch.cat(list(tight.gradients.values())) - exact).norm() < 1e-9 * exact.norm()


def test_weights_are_the_bins_probabilities_shared_by_their_images(problem):
    weights = problem[0].weights(PSI)
    torch.testing.assert_close(weights, 0.5 * torch.softmax(PSI, -1).flatten())


@pytest.mark.parametrize("k", [2, 3, 8])
def test_contrasts_are_a_basis_of_centred_logits(k):
    rows = contrasts(k)
    torch.testing.assert_close(rows @ rows.T, torch.eye(k - 1, dtype=DOUBLE))
    assert rows.sum(-1).abs().max() < 1e-14

"""What psi lowers: the loss, or one minus the smooth average precision, and its scores by class."""

import pytest
import torch
from small_loop import TINY

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.classifier import Classifier
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.outer.objective import Loss, Objective
from neural_sim.solver.hvp import gradient
from neural_sim.solver.operator import flatten, unflatten


@pytest.fixture
def made(scene, generator):
    """An objective in float64, and a detector's trained part after a little noise."""

    def make(kind):
        detector = Classifier(2, 32) if kind == "accuracy" else RetinaNet(**TINY)
        images = scene.training_set(torch.zeros(2, 4), 5, generator).images
        backbone, trainable = detector.split(detector.init(generator))
        noisy = {
            k: v.double() + 0.05 * torch.randn(v.shape, generator=generator).double()
            for k, v in trainable.items()
        }
        score = {"loss": Loss(), "average_precision": SmoothAP(), "accuracy": SmoothAccuracy()}[kind]
        return Objective(CachedSet.of(detector, backbone, images).double(), images, score), noisy

    return make


@pytest.mark.parametrize("kind", ["loss", "average_precision", "accuracy"])
def test_its_slope_is_that_of_central_differences(made, kind, generator):
    objective, params = made(kind)
    slope = gradient(objective.terms(), params)
    along = torch.randn(slope.shape, generator=generator, dtype=torch.float64)

    def value(step):
        moved = unflatten(flatten(params) + step * along, params)
        with torch.no_grad():
            return float(sum(term(moved) for term in objective.terms()))

    # The error of a central difference is 1e-10 in relative size here, and which detections are ranked stays the same.
    assert float(slope @ along) == pytest.approx((value(1e-6) - value(-1e-6)) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("kind", ["average_precision", "accuracy"])
def test_scores_add_up_to_what_psi_lowers(made, kind):
    objective, params = made(kind)
    with torch.no_grad():
        whole = float(sum(term(params) for term in objective.terms()))
    assert float(objective.scores(objective.outputs(params)).sum(1).mean()) == pytest.approx(
        1.0 - whole, abs=1e-12
    )
    objective, params = made("loss")
    scores = objective.scores(objective.outputs(params)).sum(1)
    # As many images of each class: the mean over classes is that over images.
    with torch.no_grad():
        whole = float(sum(term(params) for term in objective.terms()))
    assert float(scores.mean()) == pytest.approx(-whole, rel=1e-9)


def test_a_class_without_a_box_has_no_score_and_stays_out_of_the_mean(made):
    objective, params = made("average_precision")
    first = objective.images.labels[:, 0] == 0
    rows = first.nonzero().flatten()
    fewer = Objective(objective.cached.select(rows), objective.images.select(rows), SmoothAP())
    scores = fewer.scores(fewer.outputs(params)).sum(1)
    assert bool(scores[1].isnan()) and bool(scores[0].isfinite())
    with torch.no_grad():
        assert float(sum(term(params) for term in fewer.terms())) == pytest.approx(
            1.0 - float(scores[0]), abs=1e-12
        )


def test_folds_share_the_images_of_every_class_and_their_mean_loss_is_the_whole(made, generator):
    objective, params = made("loss")
    folds = objective.folds(2, generator)
    assert [len(fold.images) for fold in folds] == [5, 5]
    counts = [torch.bincount(fold.images.labels[:, 0], minlength=2).tolist() for fold in folds]
    assert all(abs(a - b) <= 1 for a, b in zip(*counts, strict=True))
    flat = objective.images.images.flatten(1)
    parts = torch.cat([fold.images.images.flatten(1) for fold in folds])
    assert torch.equal(flat[flat.sum(1).argsort()], parts[parts.sum(1).argsort()])

    def loss(part):
        return float(sum(term(params) for term in part.terms()))

    assert sum(map(loss, folds)) / 2 == pytest.approx(loss(objective), rel=1e-12)


def test_more_folds_than_images_are_an_image_each(made, generator):
    objective, _ = made("loss")
    assert [len(fold.images) for fold in objective.folds(20, generator)] == [1] * 10


def test_a_class_is_unseen_whose_score_without_its_loss_is_next_to_nothing(made, monkeypatch):
    objective, params = made("average_precision")
    outputs = objective.outputs(params)
    for kind, parts, wanted in [
        (SmoothAP, [[0.01, 0.009], [0.01, 0.011]], [True, False]),
        (SmoothAP, [[torch.nan, torch.nan], [0.0, 0.0]], [False, True]),
    ]:
        monkeypatch.setattr(kind, "__call__", lambda *_, parts=parts: torch.tensor(parts))
        assert objective.unseen(outputs).tolist() == wanted
    objective, params = made("loss")
    assert objective.unseen(objective.outputs(params)).tolist() == [False, False]

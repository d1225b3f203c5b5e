"""Sets of images at their edges: none, none with a box, a class without one, one image; boxes of a pixel and
of the image.

What is right has a closed form: AP of constructed detections, losses that add over images, targets that are background.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.metrics import evaluate
from neural_sim.detector.module import Optimisation
from neural_sim.detector.protocol import Parameters
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Head
from neural_sim.detector.targets import BACKGROUND
from neural_sim.detector.training import mean_loss, train_detector
from neural_sim.gradient.base import from_contributions
from neural_sim.gradient.hypergradient import InnerProblem
from neural_sim.gradient.stratified import stratified
from neural_sim.solver.flatten import flatten
from neural_sim.solver.hvp import gradient
from neural_sim.stress.cases import Check, Checks, Scope, case, eps
from neural_sim.target.split import split
from neural_sim.types import LabelledImages

SIDE, CLASSES = 32, ("can", "mug", "drill")
DOUBLE = torch.float64


def detector() -> RetinaNet:
    return RetinaNet(3, SIDE, anchors=Anchors(sizes=((10,), (18,)), reference=SIDE), head=Head(8, 1))


def images_of(
    generator: torch.Generator,
    boxes: list[list[list[float]]],
    labels: list[list[int]],
    dtype: torch.dtype = DOUBLE,
) -> LabelledImages:
    pixels = torch.rand(len(boxes), 3, SIDE, SIDE, generator=generator, dtype=DOUBLE).to(dtype)
    return LabelledImages(
        pixels, torch.tensor(boxes, dtype=dtype).reshape(len(boxes), -1, 4),
        torch.tensor(labels, dtype=torch.long).reshape(len(boxes), -1), torch.full((len(boxes),), -1),
    )  # fmt: skip


def some(generator: torch.Generator, dtype: torch.dtype = DOUBLE) -> LabelledImages:
    """Three images: one box, two boxes, none."""
    boxes = [[[4.0, 4, 15, 14], [0, 0, 0, 0]], [[8, 9, 26, 27], [1, 1, 11, 12]], [[0.0] * 4] * 2]
    return images_of(generator, boxes, [[0, -1], [1, 0], [-1, -1]], dtype)


def empty(generator: torch.Generator, dtype: torch.dtype = DOUBLE) -> LabelledImages:
    return some(generator, dtype).select(slice(0, 0))


def double(params: Parameters) -> Parameters:
    return {name: value.double() for name, value in params.items()}


def found(boxes: list[list[float]], scores: list[float], labels: list[int]) -> dict[str, Tensor]:
    return {
        "boxes": torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        "scores": torch.tensor(scores, dtype=torch.float32),
        "labels": torch.tensor(labels, dtype=torch.long),
    }


def refusal(quantity: str, action: Callable[[], object]) -> Check:
    """Passes where the action raises a ValueError and nothing else."""
    try:
        action()
        status = "accepted"
    except ValueError:
        status = "ValueError"
    return Check(quantity, float(status == "accepted"), 0.0, status, ("ValueError",))


@case
def empty_target_set(scope: Scope) -> Checks:
    """A mean over no images does not exist: everything that would take one refuses with a ValueError; what is a list
    over images is an empty list.
    """
    network, generator = detector(), scope.generator()
    params = double(network.init(generator))
    backbone, _ = network.split(params)
    nothing = empty(generator)
    yield refusal("target set under the backbone", lambda: CachedSet.of(network, backbone, nothing))
    yield refusal("validation and test from no images", lambda: split(range(len(nothing)), 0.5, generator))
    yield refusal("training", lambda: train_detector(network, params, nothing, generator, Optimisation(1)))
    yield refusal("mean loss", lambda: mean_loss(network, params, nothing))
    yield refusal("AP", lambda: evaluate([], nothing, CLASSES))
    yield refusal("joining no sets", lambda: LabelledImages.concatenate([]))
    yield refusal("inner problem", lambda: InnerProblem({}, lambda p, rows: rows, torch.zeros(0)))
    yield Check("detections in no images", float(len(network.predict(params, nothing.images))), 0.0)
    joined = LabelledImages.concatenate([nothing, some(generator)])
    yield Check("images lost by joining an empty set", float(abs(len(joined) - 3)), 0.0)


@case
def images_without_boxes(scope: Scope) -> Checks:
    """No anchor has anything to find: every label is background, padding of any width gives the same loss,
    which is the focal sum (n eps of its terms); the gradient is finite and training lowers the loss. AP does
    not exist (nan). Beside an image with a box, a false positive of higher score halves the precision: AP =
    1/2 exactly.
    """
    network, generator = detector(), scope.generator()
    params = double(network.init(generator))
    backbone, head = network.split(params)
    pixels = torch.rand(3, 3, SIDE, SIDE, generator=generator, dtype=DOUBLE)
    losses = []
    for width in (0, 1, 4):
        padded = LabelledImages(
            pixels, torch.zeros(3, width, 4, dtype=DOUBLE), torch.full((3, width), -1), torch.full((3,), -1)
        )
        cached = CachedSet.of(network, backbone, padded)
        foreign = int((cached.targets.labels != BACKGROUND).sum())
        yield Check(f"anchors not background: {width} rows of padding", float(foreign), 0.0)
        losses.append(cached.losses(head, torch.arange(3)))
        inner = InnerProblem(head, cached.losses, torch.full((3,), 1.0 / 3.0, dtype=DOUBLE))
        slope = gradient(inner.terms(), head)
        wrong = float((~torch.isfinite(slope)).sum()) + float(slope.norm() == 0.0)
        yield Check(f"gradients not finite, or zero: {width} rows of padding", wrong, 0.0)
    spread = max(float((loss - losses[0]).abs().max()) for loss in losses)
    yield Check(
        "losses by rows of padding", spread, len(network.anchors) * 3 * eps(DOUBLE) * float(losses[0].max())
    )
    single = images_of(generator, [[[0.0] * 4]] * 3, [[-1]] * 3, torch.float32)
    start = network.init(scope.generator())
    trained, _ = train_detector(network, start, single, generator, Optimisation(3, batch_size=2))
    gain = mean_loss(network, trained, single) - mean_loss(network, start, single)
    yield Check("loss gained by training", max(0.0, gain), 0.0)
    wrong = sum(
        int((~torch.isfinite(value)).sum()) for value in trained.values() if value.is_floating_point()
    )
    yield Check("parameters not finite after training", float(wrong), 0.0)
    score = evaluate([found([[1, 1, 9, 9]], [0.9], [0])] * 3, single, CLASSES).ap
    yield Check("AP without any box is a number", float(not math.isnan(float(str(score)))), 0.0)
    pair = images_of(generator, [[[1.0, 1, 9, 9]], [[0.0] * 4]], [[0], [-1]], torch.float32)
    detections = [found([[1, 1, 9, 9]], [0.5], [0]), found([[1, 1, 9, 9]], [0.9], [0])]
    score = evaluate(detections, pair, CLASSES).ap
    yield Check("AP with a false positive on a bare image, from 1/2", abs(float(str(score)) - 0.5), 1e-6)


@case
def absent_class(scope: Scope) -> Checks:
    """A class that never appears has no AP and stays out of the mean; what is detected of it costs the others
    only the box that it claims. Its logits are background everywhere, so the loss and its gradient stay
    finite.
    """
    generator = scope.generator()
    truth = images_of(generator, [[[1.0, 1, 9, 9]]] * 3, [[0], [0], [1]], torch.float32)
    right = [found([[1, 1, 9, 9]], [0.9], [label]) for label in (0, 0, 1)]
    for label, detections, mean in (
        ("all found", right, 1.0),
        (
            "and a detection of the absent class",
            [*right[:2], found([[1, 1, 9, 9]] * 2, [0.9, 0.8], [1, 2])],
            1.0,
        ),
        ("one box taken for the absent class", [*right[:2], found([[1, 1, 9, 9]], [0.9], [2])], 0.5),
        ("nothing found", [found([], [], [])] * 3, 0.0),
    ):
        score = evaluate(detections, truth, CLASSES)
        absent = math.isnan(score.per_class["drill"])
        yield Check(f"AP of the absent class is a number: {label}", float(not absent), 0.0)
        yield Check(f"mean AP, from {mean:g}: {label}", abs(score.ap - mean), 1e-6)
    network = detector()
    backbone, head = network.split(double(network.init(generator)))
    cached = CachedSet.of(network, backbone, some(generator))
    slope = gradient(cached.mean_terms(), head)
    yield Check("gradients not finite", float((~torch.isfinite(slope)).sum()), 0.0)


@case
def batch_of_one(scope: Scope) -> Checks:
    """An image's loss is its own, whatever is in the batch: n anchors' terms and the network's sums differ by
    rounding only, 1e3 eps for some hundred terms a sum in ten layers. The gradient of the mean is the mean of
    the gradients, likewise. Training on one image and estimating from one score are finite; one score has no
    standard error (inf).
    """
    network, generator = detector(), scope.generator()
    backbone, head = network.split(double(network.init(generator)))
    batch = some(generator)
    cached = CachedSet.of(network, backbone, batch)
    together = cached.losses(head, torch.arange(3))
    slopes = []
    for row in range(3):
        single = CachedSet.of(network, backbone, batch.select(slice(row, row + 1)))
        alone = single.losses(head, torch.arange(1))
        bound = 1e3 * eps(DOUBLE) * float(together[row])
        yield Check(f"loss of image {row} alone", abs(float(alone - together[row])), bound)
        slopes.append(gradient(single.mean_terms(), head))
    joint = gradient(cached.mean_terms(), head)
    error = float((torch.stack(slopes).mean(0) - joint).norm())
    yield Check("mean of single gradients", error, 1e3 * eps(DOUBLE) * sum(float(s.norm()) for s in slopes))
    start = network.init(scope.generator())
    for count in (1, 3):
        chosen = some(scope.generator(), torch.float32).select(slice(0, count))
        trained, history = train_detector(network, start, chosen, generator, Optimisation(2, batch_size=1))
        wrong = int(
            (~torch.isfinite(flatten({k: v for k, v in trained.items() if v.is_floating_point()}))).sum()
        )
        yield Check(f"parameters not finite: {count} images, batches of one", float(wrong), 0.0)
        yield Check(f"steps: {count} images, batches of one", float(abs(history.steps - 2 * count)), 0.0)
    psi = torch.zeros(8, dtype=DOUBLE)
    one = torch.tensor([2.0], dtype=DOUBLE)
    estimate = stratified(one, torch.tensor([3]), psi, lambda x: torch.log_softmax(x, -1))
    # Every bin not seen takes the mean of those that are: with one score all are equal, and the derivative is 0.
    yield Check("stratified estimate from one score", float(estimate.value.abs().max()), 8 * eps(DOUBLE))
    finite = float(torch.isfinite(estimate.standard_error).any())
    yield Check("finite standard errors from one score", finite, 0.0)
    lone = from_contributions(torch.ones(1, 8, dtype=DOUBLE))
    yield Check(
        "finite standard errors from one contribution", float(torch.isfinite(lone.standard_error).any()), 0.0
    )


@case
def extreme_boxes(scope: Scope) -> Checks:
    """Boxes of one pixel, of the whole image, at its corner, and a sliver: each claims the anchor that
    overlaps it most (low quality matches), its code decodes to the box itself, and loss and gradient are
    finite. No area is refused.
    """
    network, generator = detector(), scope.generator()
    backbone, head = network.split(double(network.init(generator)))
    cases = {
        "one pixel": [16.0, 16.0, 17.0, 17.0],
        "a corner pixel": [0.0, 0.0, 1.0, 1.0],
        "the whole image": [0.0, 0.0, float(SIDE), float(SIDE)],
        "a sliver": [0.0, 15.0, float(SIDE), 15.5],
    }
    for label, box in cases.items():
        images = images_of(generator, [[box]], [[1]])
        cached = CachedSet.of(network, backbone, images)
        claimed = cached.targets.labels[0] >= 0
        yield Check(f"boxes without an anchor: {label}", float(not bool(claimed.any())), 0.0)
        anchors = network.anchors.double()[claimed]
        sides = anchors[:, 2:] - anchors[:, :2]
        deltas = cached.targets.deltas[0, claimed]
        centres = 0.5 * (anchors[:, 2:] + anchors[:, :2]) + deltas[:, :2] * sides
        halves = 0.5 * sides * deltas[:, 2:].exp()
        decoded = torch.cat([centres - halves, centres + halves], -1)
        error = float((decoded - torch.tensor(box, dtype=DOUBLE)).abs().max())
        # Anchors are in float32, exactly representable here; coding and decoding round a handful of times.
        yield Check(f"decoded box: {label}", error, 16 * eps(DOUBLE) * SIDE)
        slope = gradient(cached.mean_terms(), head)
        yield Check(f"gradients not finite: {label}", float((~torch.isfinite(slope)).sum()), 0.0)
    for label, box in {"no width": [3.0, 3.0, 3.0, 9.0], "reversed": [9.0, 3.0, 4.0, 8.0]}.items():
        bad = images_of(generator, [[box]], [[1]])
        yield refusal(f"a box of {label}", lambda bad=bad: CachedSet.of(network, backbone, bad))

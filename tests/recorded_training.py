"""A training small enough for float64: the micro detector on images of noise, its batches and learning rates fixed."""

from __future__ import annotations

import torch

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Detector
from neural_sim.detector.retinanet import RetinaNet
from neural_sim.detector.settings import Anchors, Backbone, Head
from neural_sim.detector.trajectory import AdamW, Recording, train
from neural_sim.gradient.reversal import Examples, RecordedTraining
from neural_sim.gradient.unrolled import Unrolled
from neural_sim.solver.operator import flatten, unflatten
from neural_sim.types import LabelledImages

DOUBLE = torch.float64
ALL = Recording()
EXACT = Unrolled("reverse_over_reverse", scored_steps=0, floor=0.0)
RULE = AdamW(0.05)
RATES = tuple(
    3e-3 * part for part in (0.3, 0.7, 1.0, 0.9, 0.6, 0.2)
)  # warm-up, the peak, decay to nearly zero
STEP = 1e-5  # of differences: AdamW's steps bend within |gradient| of their start, some entries of which are tiny


class Micro:
    """The micro detector and a few images of noise with boxes, in float64, some to train on and some to validate on."""

    def __init__(self, proximal: float = 0.0, detector: Detector | None = None, layers: int = 0) -> None:
        generator = torch.Generator().manual_seed(3)
        micro = RetinaNet(3, 32, Backbone("micro"), Head(8, 1), Anchors(sizes=((14,), (28,)), reference=48))
        detector = (detector or micro).in_loop(layers)
        params = {
            name: value.double() + 0.05 * torch.randn(value.shape, generator=generator, dtype=DOUBLE)
            for name, value in detector.init(generator).items()
        }
        backbone, self.like = detector.split(params)
        self.cached = CachedSet.of(detector, backbone, _noise(8, generator))
        self.validation = CachedSet.of(detector, backbone, _noise(4, generator)).mean_terms()
        anchor = {name: value + 0.1 for name, value in self.like.items()} if proximal else None
        self.examples = Examples(self.cached.inputs, self.cached.losses_from, proximal, anchor)
        orders = [torch.randperm(8, generator=generator) for _ in range(2)]
        self.rows = tuple(part for order in orders for part in order.split(3))  # batches of 3, 3 and 2

    def weighted(self, weights):
        """The same examples, every image's loss times its weight."""
        base = self.examples
        return Examples(
            base.inputs,
            lambda p, x, rows: weights[rows] * base.losses(p, x, rows),
            base.proximal,
            base.anchor,
        )

    def trained(self, examples, recording=ALL, rule=RULE):
        return train(
            rule, flatten(self.like), self.rows, RATES,
            lambda theta, rows: examples.gradient(theta, self.like, rows), recording,
        )  # fmt: skip

    def outer(self, theta):
        return float(sum(term(unflatten(theta, self.like)) for term in self.validation))

    def slope(self, theta):
        point = theta.detach().requires_grad_()
        return torch.autograd.grad(sum(t(unflatten(point, self.like)) for t in self.validation), point)[0]

    def accumulated(self, how=EXACT, examples=None, recording=ALL, rule=RULE, **wanted):
        examples = examples or self.examples
        made = self.trained(examples, recording, rule)
        generator = torch.Generator().manual_seed(0)
        training = RecordedTraining(made, examples, self.like)
        return how.accumulate(training, self.slope(made.end), generator, **wanted)


def _noise(count, generator):
    images = torch.rand(count, 3, 32, 32, generator=generator, dtype=DOUBLE)
    corner = torch.rand(count, 1, 2, generator=generator, dtype=DOUBLE) * 14
    side = 6 + torch.rand(count, 1, 2, generator=generator, dtype=DOUBLE) * 12
    labels = torch.randint(0, 3, (count, 1), generator=generator)
    return LabelledImages(images, torch.cat([corner, corner + side], -1), labels, torch.full((count,), -1))


def extrapolated(function, step):
    """The central difference of a function of one number at 0, its error of fourth order in the step."""
    coarse, fine = ((function(h) - function(-h)) / (2 * h) for h in (step, step / 2))
    return (4 * fine - coarse) / 3

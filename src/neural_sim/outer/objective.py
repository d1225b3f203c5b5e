"""The outer objective L_val, a loss or score of the trained detector on validation images, and its parts by class."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from neural_sim.detector.cached_set import CachedSet
from neural_sim.detector.protocol import Outputs, Parameters
from neural_sim.detector.smooth_scores import SmoothAccuracy, SmoothAP
from neural_sim.solver.hvp import Term
from neural_sim.types import LabelledImages

UNSEEN = 0.02
"""Score below which next to nothing of a class is found."""


@dataclass(frozen=True)
class Loss:
    """``outer.objective``: the mean loss of the validation images, as in the paper."""


@dataclass(frozen=True)
class Objective:
    """L_val as a function of the parameters.

    Attributes:
        cached: the validation images' features.
        images: the boxes of the same images.
        score: what is minimised: with ``Loss``, the images' mean loss; with a smooth score, one minus its mean over
            classes, plus its weight ``loss`` times the mean loss.
    """

    cached: CachedSet
    images: LabelledImages
    score: SmoothAP | SmoothAccuracy | Loss

    def folds(self, count: int, generator: torch.Generator) -> list[Objective]:
        """Split L_val by dividing the validation images at random into ``count`` parts, of at least one image each.

        If there are fewer images than that, there are as many parts as images.
        The parts have the same number of images of every class (the class of an image's first box), give or take one.
        """
        shuffled = torch.randperm(len(self.images), generator=generator)
        ordered = shuffled[self.images.labels.cpu()[shuffled, 0].argsort(stable=True)]
        count = min(count, len(ordered))
        rows = [ordered[fold::count] for fold in range(count)]
        return [replace(self, cached=self.cached.select(r), images=self.images.select(r)) for r in rows]

    def terms(self) -> list[Term]:
        """Return L_val as a sum of terms; a smooth score is one term, because average precision ranks all images."""
        if isinstance(self.score, Loss):
            return self.cached.mean_terms()
        return [lambda params: self.of_outputs(self.outputs(params))]

    def of_outputs(self, outputs: Outputs) -> Float[Tensor, ""]:
        """Compute L_val from the detector's outputs on all images."""
        loss = self.cached.detector.losses_of(outputs, self.cached.targets).mean()
        if isinstance(self.score, Loss):
            return loss
        score = self.score(self.cached.detector, outputs, self.images)
        return 1.0 - score.sum(1).nanmean() + self.score.loss * loss

    def outputs(self, params: Parameters, chunk_size: int = 64) -> Outputs:
        """Run the detector on all images; a backward pass recomputes intermediate values chunk by chunk."""
        parts = [
            checkpoint(self.cached.outputs, params, rows, use_reentrant=False)
            for rows in torch.arange(len(self.cached), device=self.cached.device).split(chunk_size)
        ]
        logits, deltas = zip(*parts, strict=True)
        return torch.cat(logits), torch.cat(deltas)

    @torch.no_grad()
    def unseen(self, outputs: Outputs) -> Bool[Tensor, "classes"]:
        """Find the classes in the images whose smooth score, without any loss, is below ``UNSEEN``; none with ``Loss``.

        There, next to no detection is right, so the score hardly changes with the parameters, or with psi.
        """
        if isinstance(self.score, Loss):
            return torch.zeros(outputs[0].shape[-1], dtype=torch.bool)
        return self.score(self.cached.detector, outputs, self.images).sum(1).cpu() < UNSEEN

    @torch.no_grad()
    def scores(self, outputs: Outputs) -> Float[Tensor, "classes images"]:
        """Compute each image's contribution to the score of every class, on the CPU; higher is better.

        A class's score, the sum of its row, is minus its part of L_val (up to the constant 1), except that its losses
        are averaged over the images with a box of the class. A class without a box is nan.
        """
        labels = self.images.labels.cpu()
        losses = self.cached.detector.losses_of(outputs, self.cached.targets).cpu()
        classes = torch.arange(outputs[0].shape[-1])
        shown = (labels == classes[:, None, None]).any(-1).to(losses)
        parts = -shown * losses / shown.sum(1, keepdim=True)
        if isinstance(self.score, Loss):
            return parts
        return self.score(self.cached.detector, outputs, self.images).cpu() + self.score.loss * parts

"""What psi lowers: a loss of the trained detector on the validation images, and its parts by class."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from neural_sim.detector.cached import CachedSet
from neural_sim.detector.protocol import Outputs, Parameters
from neural_sim.detector.smooth_ap import SmoothAP
from neural_sim.outer.settings import ObjectiveKind
from neural_sim.solver.hvp import Term
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class Objective:
    """L_val as a function of the parameters.

    ``loss`` is the mean loss of the validation images ``cached``, as in the paper. ``average_precision`` is one minus
    the mean over classes of the ``smooth`` average precision, plus ``smooth.loss`` times that loss; it needs the boxes
    of ``images``, the same ones.
    """

    cached: CachedSet
    images: LabelledImages
    kind: ObjectiveKind
    smooth: SmoothAP

    def terms(self) -> list[Term]:
        """L_val as a sum of terms; the smooth average precision, which ranks all images, is one."""
        if self.kind == "loss":
            return self.cached.mean_terms()
        return [lambda params: self.of_outputs(self.outputs(params))]

    def of_outputs(self, outputs: Outputs) -> Float[Tensor, ""]:
        """L_val of the detector's outputs on all images."""
        loss = self.cached.detector.losses_of(outputs, self.cached.targets).mean()
        if self.kind == "loss":
            return loss
        return 1.0 - self.smooth_ap(outputs).sum(1).nanmean() + self.smooth.loss * loss

    def smooth_ap(self, outputs: Outputs) -> Float[Tensor, "classes images"]:
        """What each image adds to the smooth average precision of every class; nan for a class without a box."""
        return self.smooth(self.cached.detector, outputs, self.images)

    def outputs(self, params: Parameters, chunk_size: int = 64) -> Outputs:
        """The detector's outputs on all images. Only these stay in memory for a derivative, not what led to them."""
        parts = [
            checkpoint(self.cached.outputs, params, rows, use_reentrant=False)
            for rows in torch.arange(len(self.cached), device=self.cached.device).split(chunk_size)
        ]
        logits, deltas = zip(*parts, strict=True)
        return torch.cat(logits), torch.cat(deltas)

    @torch.no_grad()
    def scores(self, outputs: Outputs) -> Float[Tensor, "classes images"]:
        """What each image adds to the score of every class, more is better. A class's score, the sum of its row, is
        L_val's part of it with the other sign, without the one; losses are the mean over images with a box of the
        class. nan for a class without one. On the CPU."""
        labels = self.images.labels.cpu()
        losses = self.cached.detector.losses_of(outputs, self.cached.targets).cpu()
        classes = torch.arange(outputs[0].shape[-1])
        own = (labels == classes[:, None, None]).any(-1).to(losses)
        parts = -own * losses / own.sum(1, keepdim=True)
        if self.kind == "loss":
            return parts
        return self.smooth_ap(outputs).cpu() + self.smooth.loss * parts

    def double(self) -> Objective:
        """The same in float64."""
        return replace(self, cached=self.cached.double())

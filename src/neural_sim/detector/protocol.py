"""The base class of detectors: what the psi loop, reports and model files need from one."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision.ops import batched_nms

from neural_sim.detector.losses import Targets
from neural_sim.detector.settings import Detections

Parameters = dict[str, Tensor]
Score = Literal["AP", "accuracy"]
"""The score of predictions: COCO's average precision, or the top-1 accuracy of each image's best class."""
SUPPRESSED = 1000
"""Largest number of boxes from several images that go through non-maximum suppression together."""
Outputs = tuple[Float[Tensor, "n anchors classes"], Float[Tensor, "n anchors code"]]


def score_of(make: Callable[..., Detector]) -> Score:
    """Return the score that judges the detectors of ``make``, a constructor as configured in ``conf/detector``."""
    while isinstance(make, functools.partial):
        make = make.func
    return getattr(make, "score", "AP")


@dataclass(frozen=True)
class Best:
    """The best detections of every class in every image, ordered by image, then class, then falling score.

    ``boxes`` are (x0, y0, x1, y1) in pixels. ``logits`` and ``boxes`` are differentiable in the outputs they come from;
    which outputs are chosen is not differentiated.
    """

    image: Int[Tensor, "m"]
    label: Int[Tensor, "m"]
    logits: Float[Tensor, "m"]
    boxes: Float[Tensor, "m 4"]


class Detector(ABC):
    """A detector for images of one size.

    It holds a shape and settings, never its parameters, which are passed in as an argument, so that losses can be
    differentiated any number of times, in forward and in reverse mode.

    A class is constructed with ``num_classes`` and ``image_size``, (height, width) in pixels, by name; other arguments
    come from its file in ``conf/detector``. It sets both attributes, and may set the others:

    - ``proximal``: lambda of ``lambda / 2 |theta - theta_0|^2`` in the psi loop's inner problem, where theta_0 is the
        warm start;
    - ``detections``: which predictions count as detections;
    - ``anchors_per_level``: number of anchors of each level; the best candidates are taken level by level. None: one
        level;
    - ``normalisation``: how ``features`` first normalises the channels of images, for model files;
    - ``score``: the kind of score.

    "Anchors" stands for whatever the outputs belong to, boxes (RetinaNet) or points (FCOS). A subclass defines the
    abstract methods; docs/extending.md has an example.
    """

    normalisation: ClassVar[Mapping[str, tuple[float, ...]] | None] = None
    score: ClassVar[Score] = "AP"
    num_classes: int
    image_size: tuple[int, int]
    proximal: float = 0.0
    detections: Detections = Detections()
    anchors_per_level: Sequence[int] | None = None

    # --- what a detector defines ---

    @abstractmethod
    def init(self, generator: torch.Generator) -> Parameters:
        """Draw all parameters, in float32 on the CPU; the backbone's names begin with ``backbone.``."""

    @abstractmethod
    def features(self, backbone: Parameters, images: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, ...]:
        """Compute the predictor's inputs from images in [0, 1], as tensors with one row for each image."""

    @abstractmethod
    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        """Compute class logits and the code of every anchor's box, differentiable in both arguments."""

    @abstractmethod
    def assign(self, boxes: Float[Tensor, "n boxes 4"], labels: Int[Tensor, "n boxes"]) -> Targets:
        """Assign a target to every anchor, differentiable in the boxes; rows with label -1 are not boxes."""

    @abstractmethod
    def losses_of(self, outputs: Outputs, targets: Targets) -> Float[Tensor, "n"]:
        """Compute the loss of each image from its own outputs alone."""

    @abstractmethod
    def decode(
        self, code: Float[Tensor, "*n code"], anchor: Int[Tensor, "m"] | None = None
    ) -> Float[Tensor, "*n 4"]:
        """Decode boxes (x0, y0, x1, y1) in pixels, within the image, differentiable in the code.

        The code is that of all anchors [n, anchors, code], or only of the anchors ``anchor`` [m, code].
        """

    # --- what follows from it ---

    def in_loop(self, layers: int | None) -> Detector:
        """Return the detector as the psi loop trains it.

        Its ``split`` counts the last ``layers`` stages of the backbone as trainable; None: the detector's own default.
        The base class has no stages.

        Raises:
            ValueError: the backbone has no such stages.
        """
        if layers:
            raise ValueError(
                f"outer.loop_layers: {type(self).__name__} has no stages, want null or 0, got {layers}"
            )
        return self

    def split(self, params: Parameters) -> tuple[Parameters, Parameters]:
        """Separate the backbone, which ``features`` uses and the psi loop freezes, from all other parameters."""
        backbone = {name: value for name, value in params.items() if name.startswith("backbone.")}
        return backbone, {name: value for name, value in params.items() if name not in backbone}

    def learnable(self, params: Parameters) -> list[str]:
        """Name the parameters that a training outside the psi loop changes: by default all."""
        return list(params)

    def per_image_loss(
        self, trainable: Parameters, features: Sequence[Tensor], targets: Targets
    ) -> Float[Tensor, "n"]:
        """Compute the losses of the outputs.

        A jvp along v gives the score <dl_i / dtheta, v> of every image in one pass.
        """
        return self.losses_of(self.outputs(trainable, features), targets)

    def ranking(self, outputs: Outputs) -> Float[Tensor, "n anchors classes"]:
        """Return logits of the scores by which detections are ranked: by default the class logits."""
        return outputs[0]

    def best(self, outputs: Outputs, per_class: int, candidates: int = 100) -> Best:
        """Choose at most ``per_class`` detections of each class in each image.

        Non-maximum suppression chooses them among the image's ``candidates`` best logits. There is no score threshold:
        the score of an object that is missed now must be able to rise.
        """
        logits, code = self.ranking(outputs), outputs[1]
        top, index = logits.detach().flatten(1).topk(min(candidates, logits[0].numel()))
        image = torch.arange(len(top), device=top.device)[:, None].expand_as(index).flatten()
        anchor, label = (index // self.num_classes).flatten(), (index % self.num_classes).flatten()
        group = image * self.num_classes + label
        boxes = self.decode(code.detach()[image, anchor], anchor)
        # In blocks of images, because the time of batched_nms grows with the square of their number.
        block = max(1, SUPPRESSED // top.shape[1]) * top.shape[1]
        parts = zip(
            *(part.split(block) for part in (boxes.double(), top.flatten().double(), group)), strict=True
        )
        kept = torch.cat(
            [
                number * block + batched_nms(some, scores, own - own[0], self.detections.nms_iou)
                for number, (some, scores, own) in enumerate(parts)
            ]
        )
        kept = kept[group[kept].argsort(stable=True)]
        place = torch.arange(len(kept), device=kept.device) - torch.searchsorted(group[kept], group[kept])
        image, anchor, label = (part[kept[place < per_class]] for part in (image, anchor, label))
        return Best(image, label, logits[image, anchor, label], self.decode(code[image, anchor], anchor))

    @torch.no_grad()
    def predict(
        self, params: Parameters, images: Float[Tensor, "n 3 h w"], batch_size: int = 64
    ) -> list[dict[str, Tensor]]:
        """Detect objects in each image.

        Returns:
            For each image, best first, on the CPU: boxes [d, 4] in pixels, scores [d], labels [d]; see ``Detections``.
        """
        backbone, trainable = self.split(params)
        detections, device = [], next(iter(trainable.values())).device
        for chunk in images.split(batch_size) if len(images) else ():
            outputs = self.outputs(trainable, self.features(backbone, chunk.to(device)))
            detections += self._chosen(self.ranking(outputs).sigmoid(), outputs[1])
        return detections

    def _chosen(
        self, scores: Float[Tensor, "n anchors classes"], code: Float[Tensor, "n anchors code"]
    ) -> list[dict[str, Tensor]]:
        """Choose the candidates of all images at once, on the device, and move only these to the CPU."""
        levels, first = [], 0
        for level in scores.split(list(self.anchors_per_level or [scores.shape[1]]), 1):
            best, index = level.flatten(1).topk(min(self.detections.candidates, level[0].numel()))
            levels.append((best, index + first * self.num_classes))
            first += level.shape[1]
        best, index = (torch.cat(part, 1) for part in zip(*levels, strict=True))
        anchor, labels = index // self.num_classes, index % self.num_classes
        moves = code.gather(1, anchor[..., None].expand(-1, -1, code.shape[-1]))
        chosen = (part.cpu() for part in (best, anchor, labels, moves))
        return [self._suppressed(*image) for image in zip(*chosen, strict=True)]

    def _suppressed(self, best: Tensor, anchor: Tensor, labels: Tensor, moves: Tensor) -> dict[str, Tensor]:
        """Return one image's detections among its candidates."""
        keep = best > self.detections.score_threshold
        best, anchor, labels, moves = (part[keep] for part in (best, anchor, labels, moves))
        boxes = self.decode(moves, anchor)
        keep = batched_nms(boxes, best, labels, self.detections.nms_iou)[: self.detections.limit]
        return {"boxes": boxes[keep], "scores": best[keep], "labels": labels[keep]}

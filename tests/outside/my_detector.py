"""A detector from outside the package: one convolution for features, one for classes and boxes, an anchor a cell."""

import torch
from torch.nn import functional as F
from torchvision.models.detection._utils import BoxCoder

from neural_sim.detector.losses import box_loss, focal_loss
from neural_sim.detector.protocol import Best
from neural_sim.detector.targets import IGNORED, assign_anchors


class Cells:
    def __init__(self, num_classes: int, image_size: tuple[int, int], cell: int = 8, proximal: float = 0.0):
        if any(side % cell for side in image_size):
            raise ValueError(f"detector.cell must divide the image's {image_size} pixels, got {cell}")
        self.num_classes, self.image_size, self.cell, self.proximal = num_classes, image_size, cell, proximal
        corner = torch.cartesian_prod(*(torch.arange(0.0, side, cell) for side in image_size)).flip(-1)
        self.anchors = torch.cat([corner - cell, corner + 2 * cell], -1)

    def init(self, generator):
        return {
            "backbone.weight": torch.randn(16, 3, self.cell, self.cell, generator=generator) / self.cell,
            "head.weight": torch.zeros(self.num_classes + 4, 16, 1, 1),
            "head.bias": torch.tensor([-3.0] * self.num_classes + [0.0] * 4),
        }

    def split(self, params):
        backbone = {name: value for name, value in params.items() if name.startswith("backbone.")}
        return backbone, {name: value for name, value in params.items() if name not in backbone}

    def learnable(self, params):
        return list(params)

    def features(self, backbone, images):
        weight = backbone["backbone.weight"]
        return (F.silu(F.conv2d(images.to(weight.dtype), weight, stride=self.cell)),)

    def outputs(self, trainable, features):
        maps = F.conv2d(features[0], trainable["head.weight"], trainable["head.bias"])
        rows = maps.flatten(2).transpose(1, 2)
        return rows[..., : self.num_classes], rows[..., self.num_classes :]

    def assign(self, boxes, labels):
        return assign_anchors(self.anchors.to(boxes), boxes, labels, 0.5, 0.4)

    def losses_of(self, outputs, targets):
        logits, deltas = outputs
        wanted = (targets.labels[..., None] == torch.arange(self.num_classes)).to(logits.dtype)
        counted = (targets.labels != IGNORED).to(logits.dtype)
        found = (targets.labels >= 0).to(logits.dtype)
        classes = focal_loss(logits, wanted, 0.25, 2.0).sum(-1) * counted
        boxes = box_loss(deltas - targets.deltas.to(deltas.dtype), "pseudo_huber", 0.1).sum(-1) * found
        return (classes + boxes).sum(-1) / found.sum(-1).clamp(min=1)

    def per_image_loss(self, trainable, features, targets):
        return self.losses_of(self.outputs(trainable, features), targets)

    def best(self, outputs, per_class):
        logits, deltas = outputs
        anchor = logits.detach().topk(1, dim=1).indices[:, 0]  # one of each class in each image
        image, label = (index.flatten() for index in torch.where(torch.ones_like(anchor, dtype=torch.bool)))
        anchor = anchor.flatten()
        boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(deltas[image, anchor], self.anchors[anchor])
        return Best(image, label, logits[image, anchor, label], boxes)

    @torch.no_grad()
    def predict(self, params, images, batch_size=64):
        backbone, trainable = self.split(params)
        logits, deltas = self.outputs(trainable, self.features(backbone, images))
        found = []
        for scores, moves in zip(logits.sigmoid(), deltas, strict=True):
            best, anchor = scores.max(-1).values.topk(5)
            boxes = BoxCoder((1.0, 1.0, 1.0, 1.0)).decode_single(moves[anchor], self.anchors[anchor])
            found.append({"boxes": boxes, "scores": best, "labels": scores[anchor].argmax(-1)})
        return found

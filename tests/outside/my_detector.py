"""A detector from outside the package: one convolution for features, one for classes and boxes, an anchor a cell."""

import torch
from torch.nn import functional as F

from neural_sim.detector.losses import IGNORED, assign_anchors, box_loss, focal_loss
from neural_sim.detector.protocol import Detector


class Cells(Detector):
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
        logits, code = outputs
        wanted = F.one_hot(targets.labels.clamp(min=0), self.num_classes) * (targets.labels >= 0)[..., None]
        counted, found = (targets.labels != IGNORED).to(logits), (targets.labels >= 0).to(logits)
        classes = focal_loss(logits, wanted.to(logits), 0.25, 2.0).sum(-1) * counted
        boxes = box_loss(code - targets.deltas.to(code), "pseudo_huber", 0.1).sum(-1) * found
        return (classes + boxes).sum(-1) / found.sum(-1).clamp(min=1)

    def decode(self, code, anchor=None):
        x0, y0, x1, y1 = self.anchors.to(code)[slice(None) if anchor is None else anchor].unbind(-1)
        width, height = x1 - x0, y1 - y0
        x, y = 0.5 * (x0 + x1) + code[..., 0] * width, 0.5 * (y0 + y1) + code[..., 1] * height
        half = 0.5 * width * code[..., 2].exp(), 0.5 * height * code[..., 3].exp()
        sides = torch.stack([x - half[0], y - half[1], x + half[0], y + half[1]], -1)
        rows, columns = self.image_size
        return sides.clamp(min=0.0).minimum(sides.new_tensor([columns, rows, columns, rows]))

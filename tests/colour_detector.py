"""A detector whose results are known: red blocks where they are, green ones a part of their width to the right."""

import torch

from neural_sim.detector.protocol import Detector


class ColourDetector(Detector):
    """``shift`` is that of green blocks' boxes in their widths."""

    features = outputs = assign = losses_of = decode = None  # only predicts

    def __init__(self, num_classes, image_size, shift=0.27):
        self.image_size, self.shift = image_size, shift

    def init(self, generator):
        return {"unused": torch.zeros(1)}

    def predict(self, params, images, batch_size=64):
        return [self._found(image) for image in images]

    def _found(self, image):
        boxes, labels = [], []
        for label in (0, 1):
            pure = (image[label] > 0.6) & (image[1 - label] < 0.4) & (image[2] < 0.4)
            if pure.any():
                rows, columns = (torch.where(pure.any(axis))[0] for axis in (1, 0))
                shift = label * self.shift * float(columns[-1] + 1 - columns[0])
                boxes.append(
                    [
                        float(columns[0]) + shift,
                        float(rows[0]),
                        float(columns[-1]) + 1 + shift,
                        float(rows[-1]) + 1,
                    ]
                )
                labels.append(label)
        scores = torch.tensor([0.9, 0.8])[torch.tensor(labels, dtype=torch.long)]
        return {
            "boxes": torch.tensor(boxes).reshape(-1, 4),
            "scores": scores,
            "labels": torch.tensor(labels, dtype=torch.long),
        }

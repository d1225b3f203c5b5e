"""Photographs of any size: the detector sees them letterboxed, its boxes come back in the photograph's pixels."""

import torch
from PIL import Image

from neural_sim.detector.saved import SavedDetector, detect
from neural_sim.target.photographs import letterbox


class Bright:
    """Finds the box of the pixels above 0.9, and one in the border's corner."""

    def __init__(self, num_classes, image_size):
        self.image_size = image_size

    def predict(self, params, images, batch_size=64):
        found = []
        for image in images:
            assert image.shape == (3, *self.image_size)
            rows, columns = (torch.where((image.mean(0) > 0.9).any(axis))[0] for axis in (1, 0))
            box = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
            boxes = torch.tensor([[float(side) for side in box], [0.0, 0.0, 3.0, 3.0]])
            found.append({"boxes": boxes, "scores": torch.tensor([0.9, 0.8]), "labels": torch.tensor([0, 0])})
        return found


def test_boxes_come_back_in_the_photographs_pixels():
    """Wide, tall, large and small photographs with a white box on black; one detection lies in the border alone."""
    saved = SavedDetector(Bright, {}, ("box",), (64, 96))
    for size, box in (
        ((960, 320), (300, 80, 600, 160)),
        ((40, 160), (8, 40, 24, 120)),
        ((24, 8), (6, 2, 12, 4)),
    ):
        photo = Image.new("RGB", size)
        photo.paste((255, 255, 255), box)
        (found,) = detect(saved, [photo])
        scale = min(64 / size[1], 96 / size[0])
        assert found["scores"].tolist() == torch.tensor([0.9]).tolist()
        # A pixel of the detector's; where it is smaller than the photograph's, enlarging blurs by half of that.
        assert (found["boxes"][0] - torch.tensor(box)).abs().max() <= max(1.0 / scale, 0.5)


def test_the_inverse_of_the_letterbox_is_exact_inside_and_clips_outside(generator):
    for width, height in ((640, 480), (333, 1000), (7, 5)):
        _, placing = letterbox(Image.new("RGB", (width, height)), 96, 128)
        corner = torch.rand(50, 2, generator=generator, dtype=torch.float64)
        size = torch.tensor([width, height], dtype=torch.float64)
        boxes = torch.cat(
            [corner, corner + (1 - corner) * torch.rand(50, 2, generator=generator)], -1
        ) * size.repeat(2)
        torch.testing.assert_close(placing.of_photo(placing.boxes(boxes)), boxes, rtol=1e-12, atol=1e-9)
        outside = placing.of_photo(torch.tensor([[-50.0, -50.0, 500.0, 500.0]]))
        assert outside.tolist() == [[0.0, 0.0, float(width), float(height)]]


def test_no_photographs_give_no_detections():
    assert detect(SavedDetector(Bright, {}, ("box",), (8, 8)), []) == []

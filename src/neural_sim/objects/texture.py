"""Printed sides of procedural objects, and their texture atlas."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

Colour = tuple[int, int, int]

# Texels repeated around each panel, so that mip levels do not mix neighbours: enough for a 16-fold reduction.
MARGIN = 16


class Print:
    """A printed side; coordinates in [0, 1], x to the right and y upwards as seen from outside, object upright."""

    def __init__(self, width: int, height: int, paper: Colour) -> None:
        self._image = Image.new("RGB", (width, height), paper)
        self._draw = ImageDraw.Draw(self._image)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
        """Fill the rectangle between two corners."""
        self._draw.rectangle(self._corners(x0, y0, x1, y1), fill=colour)

    def disc(self, x: float, y: float, radius_x: float, radius_y: float, colour: Colour) -> None:
        """Fill an ellipse."""
        corners = self._corners(x - radius_x, y - radius_y, x + radius_x, y + radius_y)
        self._draw.ellipse(corners, fill=colour)

    def polygon(self, points: list[tuple[float, float]], colour: Colour) -> None:
        """Fill a polygon."""
        width, height = self._image.size
        self._draw.polygon([(x * width, (1.0 - y) * height) for x, y in points], fill=colour)

    def text_lines(
        self, area: tuple[float, float, float, float], lines: int, colour: Colour, generator: torch.Generator
    ) -> None:
        """Print bars of random lengths in ``area`` (x0, y0, x1, y1), like lines of small print."""
        x0, y0, x1, y1 = area
        pitch = (y1 - y0) / lines
        lengths = 0.55 + 0.45 * torch.rand(lines, generator=generator, dtype=torch.float64)
        for row, length in enumerate(lengths.tolist()):
            top = y1 - row * pitch
            self.rectangle(x0, top - 0.55 * pitch, x0 + length * (x1 - x0), top, colour)

    def turned(self) -> Print:
        """Return the same print upside down."""
        other = Print(*self._image.size, (0, 0, 0))
        other._image.paste(self._image.rotate(180))
        return other

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the print's pixels."""
        return np.asarray(self._image)

    def _corners(self, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float, float, float]:
        width, height = self._image.size
        return (x0 * width, (1.0 - y1) * height, x1 * width - 1, (1.0 - y0) * height - 1)


def atlas(
    panels: list[UInt8[np.ndarray, "_h _w 3"]],
) -> tuple[Image.Image, list[tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]]]:
    """Stack panels into one image; also return the (scale, offset) from each panel's uv in [0, 1] to the atlas's."""
    width = max(panel.shape[1] for panel in panels) + 2 * MARGIN
    height = sum(panel.shape[0] + 2 * MARGIN for panel in panels)
    image = np.zeros((height, width, 3), dtype=np.uint8)
    places, top = [], 0
    for panel in panels:
        padded = np.pad(panel, ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0)), mode="edge")
        image[top : top + padded.shape[0], : padded.shape[1]] = padded
        rows, columns = panel.shape[:2]
        scale = np.array([columns / width, rows / height])
        offset = np.array([MARGIN / width, 1.0 - (top + MARGIN + rows) / height])
        places.append((scale, offset))
        top += padded.shape[0]
    return Image.fromarray(image), places

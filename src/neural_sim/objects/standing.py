"""Find what stands still in all photographs of an object: for an object on a turntable, the room."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage

from neural_sim.objects.album import Shot
from neural_sim.pictures import read_picture

LONGER = 200
"""Longer side, in pixels, at which photographs are compared."""
TEXTURE = 0.03
"""Contrast of a pixel with its surroundings, relative to white, above which it could show the camera's motion."""
CHANGE = 0.35
"""Largest change of a standing pixel from its usual value, relative to its contrast; exposure and noise cause less."""
STILL = 0.8
"""Fraction of the photographs in which a standing pixel has its usual value."""
LEAST_SHARE = 0.15
"""Smallest fraction of textured pixels that must stand still; less is a speck on the lens, or chance."""
AROUND = 5
"""Standard deviation in pixels of the Gaussian that gives a pixel's surroundings."""


def standing_parts(shots: Sequence[Shot]) -> dict[Path, Bool[np.ndarray, "_ _"]] | None:
    """Find the parts that stand still in photographs of one size; None if almost nothing does.

    Contrasts with the surroundings are compared, because exposure hardly changes them.
    """
    if len({shot.size for shot in shots}) > 1:
        return None  # the camera was turned, so it was not on a tripod
    details = np.stack([_detail(shot) for shot in shots])
    usual = np.median(details, axis=0)
    textured = np.abs(usual) > TEXTURE
    changed = np.abs(details - usual) > CHANGE * np.maximum(np.abs(usual), TEXTURE)
    still = textured & ((~changed).mean(0) >= STILL)
    share = still.sum() / max(1.0, float((np.abs(details) > TEXTURE).mean(0).sum()))
    if share < LEAST_SHARE:
        return None
    # Pixels without texture between standing pixels stand still as well.
    grown = ndimage.binary_closing(np.pad(still, 2 * AROUND, mode="reflect"), iterations=AROUND)
    grown = grown[2 * AROUND : -2 * AROUND, 2 * AROUND : -2 * AROUND]
    return {shot.image: grown for shot in shots}


def _detail(shot: Shot) -> Float[np.ndarray, "h w"]:
    factor = min(1.0, LONGER / max(shot.size))
    width, height = (max(1, round(factor * side)) for side in shot.size)
    picture = read_picture(shot.image, upright=False).convert("L")
    grey = (
        np.asarray(picture.resize((width, height), Image.Resampling.BOX, reducing_gap=3.0), np.float32)
        / 255.0
    )
    return grey - ndimage.gaussian_filter(grey, AROUND)

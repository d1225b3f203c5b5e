"""The one reader of masks, which say which pixels of a photograph show the object."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from neural_sim.pictures import WHITE, alpha_of, eight_bits, load

_LOSSY = ("JPEG", "MPO", "WEBP")
_MOST_LABELS = 32
"""If all values of a mask are smaller, and there are more than two of them, they are labels."""
_LEAST_AREA = 400
"""An object of at least this many pixels is too large to be mostly grey because of a soft edge."""
_SPREAD = 32
"""Largest difference between the channels of a grey pixel; compression makes them differ."""


def read_mask(path: Path, value: int | None = None) -> Float[np.ndarray, "height width"]:
    """Read a mask's opacity in [0, 1].

    Args:
        path: the file.
        value: the object's label in an image of labels (grey values, or indices of a palette). None: the opacity is
            found as described here.

    If there are two values, whichever they are, the darker or smaller one is the background and the other the object.
    If there is only one, it is the object unless it is 0. More values of grey are opacities relative to the format's
    white. In a coloured palette, the indices count. A picture with an alpha channel is read by its alpha if that
    varies, else by its colours.

    Raises:
        ValueError: the file cannot be read; nothing says which of several labels or colours is the object's; or
            ``value`` is given for a file with colours.
    """
    image, where = load(path, str(path))[0], str(path)
    if value is not None:
        labels = np.asarray(image)
        if labels.ndim != 2:
            raise ValueError(
                f"{where}: want labels in one channel for objects.mask_value={value}, got {image.mode}"
            )
        return (labels == value).astype(np.float32)
    lossy = image.format in _LOSSY
    if image.has_transparency_data:
        picture = eight_bits(image, where)
        alpha = alpha_of(picture)
        if alpha is not None and alpha.getextrema()[0] != alpha.getextrema()[1]:
            return np.asarray(alpha, dtype=np.float32) / 255.0
        return _coloured(picture.convert("RGB"), where, lossy)
    if image.mode == "P":
        colours = image.convert("RGB")
        return _coloured(colours, where, lossy) if _is_grey(colours) else _labels(np.asarray(image), where)
    if image.mode in ("1", "L", "F") or image.mode.startswith("I"):
        return _grey(np.asarray(image), where, lossy)
    return _coloured(eight_bits(image, where).convert("RGB"), where, lossy)


def _grey(values: np.ndarray, where: str, lossy: bool = False) -> Float[np.ndarray, "height width"]:
    """Return the opacity that the values of one channel mean."""
    if values.dtype == bool:
        return values.astype(np.float32)
    levels = np.unique(values)
    if not lossy and len(levels) <= 2:
        return _two_values(values, levels)
    whole = values.dtype != np.float32
    if whole and not lossy and levels[-1] < _MOST_LABELS:
        raise ValueError(_several(where, "labels", len(levels)))
    white = 255.0 if values.dtype == np.uint8 else WHITE if whole else 1.0
    if not (levels[0] >= 0 and levels[-1] <= white):
        raise ValueError(
            f"{where}: want a mask with values from 0 to {white:g}, got {levels[0]:g} to {levels[-1]:g}"
        )
    opacity = values.astype(np.float32) / np.float32(white)
    some, between = opacity > 0.1, (opacity > 0.1) & (opacity < 0.9)
    faint = not lossy and opacity.max() < 0.5
    if faint or (some.sum() >= _LEAST_AREA and 2 * between.sum() > some.sum()):
        raise ValueError(_several(where, "shades", len(levels)))
    return opacity


def _coloured(picture: Image.Image, where: str, lossy: bool) -> Float[np.ndarray, "height width"]:
    """Return the opacity that colours mean."""
    light = np.asarray(picture.convert("L"))
    if lossy or _is_grey(picture):
        return _grey(light, where, lossy)
    colours, places = np.unique(np.asarray(picture).reshape(-1, 3), axis=0, return_inverse=True)
    if len(colours) > 2:
        raise ValueError(_several(where, "colours", len(colours)))
    if len(colours) == 1:
        return np.full(light.shape, float(colours.any()), dtype=np.float32)
    darker = int(colours.sum(1).argmin())
    return (places.reshape(light.shape) != darker).astype(np.float32)


def _labels(values: np.ndarray, where: str) -> Float[np.ndarray, "height width"]:
    levels = np.unique(values)
    if len(levels) > 2:
        raise ValueError(_several(where, "labels", len(levels)))
    return _two_values(values, levels)


def _two_values(values: np.ndarray, levels: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Return 1 where a mask has the larger of its two values; a single value other than 0 is 1 everywhere."""
    if len(levels) == 1:
        return np.full(values.shape, float(levels[0] > 0), dtype=np.float32)
    return (values == levels[-1]).astype(np.float32)


def _several(where: str, what: str, count: int) -> str:
    return (
        f"{where}: holds {count} {what}; want a mask of one object, with two values or with opacities in grey; for "
        "labels, set objects.mask_value to the object's label"
    )


def _is_grey(picture: Image.Image) -> bool:
    values = np.asarray(picture).astype(np.int16)
    return bool((values.max(-1) - values.min(-1)).max(initial=0) <= _SPREAD)

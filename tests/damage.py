"""Damage of files, as disks, transfers and editors leave it."""

from __future__ import annotations

import numpy as np


def damaged(data: bytes, generator: np.random.Generator) -> bytes:
    """Cut off, with flipped bits, with a block of zeros, or with bytes taken out."""
    changed = bytearray(data)
    place = int(generator.integers(len(data)))
    match generator.integers(4):
        case 0:
            return data[:place]
        case 1:
            for at in generator.integers(len(data), size=generator.integers(1, 6)):
                changed[at] ^= 1 << int(generator.integers(8))
        case 2:
            changed[place : place + 16] = bytes(min(16, len(data) - place))
        case _:
            del changed[place : place + int(generator.integers(1, 9))]
    return bytes(changed)

"""Pools of painted objects, whose bins show as the place of a bright patch and whose lights as their colour."""

from dataclasses import replace

import torch

from neural_sim.synthesis.pool import PooledSubject

SIDE, EACH = 48, 24
COLOURS = {"lamp": (0.9, 0.8, 0.2), "cup": (0.2, 0.8, 0.9)}
HUES = torch.tensor([[250.0, 60, 60], [60, 250, 60], [60, 60, 250]])


def painted(name, distribution):
    """A pool of grey squares, as large as the zoom's bin says, with a patch where the pose's bin says."""
    factors, generator = distribution.binned, torch.Generator().manual_seed(len(name))
    cells = torch.cartesian_prod(*(torch.arange(f.bins) for f in factors)).view(-1, len(factors))
    bins = cells.repeat_interleave(EACH, 0)
    noise = distribution.draw_noise(len(bins), generator)
    draw = distribution.at_bins({f.name: own for f, own in zip(factors, bins.unbind(1), strict=True)}, noise)
    maps = torch.zeros(len(bins), SIDE, SIDE, 4, dtype=torch.uint8)
    for row, own in enumerate(bins):
        half = 13 if len(factors) == 1 else (16, 8)[own[1]]
        low, high = SIDE // 2 - half, SIDE // 2 + half
        maps[row, low:high, low:high] = torch.tensor([90, 90, 90, 255], dtype=torch.uint8)
        down, across = divmod(int(own[0]), 2)
        patch = torch.tensor([int(255 * c) for c in COLOURS[name]] + [255], dtype=torch.uint8)
        top, left = low + down * half, low + across * half
        maps[row, top + 2 : top + half - 2, left + 2 : left + half - 2] = patch
    return PooledSubject(name, maps.unflatten(0, (-1, EACH)), draw)


def lit(name, distribution, weights):
    """A pool of squares whose colour is a mixture of three lights', with ``weights``."""
    noise = distribution.draw_noise(len(weights), torch.Generator().manual_seed(3))
    draw = replace(distribution.at_bins({}, noise), weights=weights)
    maps = torch.zeros(len(weights), SIDE, SIDE, 4, dtype=torch.uint8)
    maps[:, 12:36, 12:36, :3] = (weights @ HUES).round().to(torch.uint8)[:, None, None]
    maps[:, 12:36, 12:36, 3] = 255
    return PooledSubject(name, maps[None], draw)


def moved(images, step):
    """The images with their boxes, ``step`` pixels further to the right."""
    boxes = images.boxes.clone()
    boxes[..., [0, 2]] = (boxes[..., [0, 2]] + step).clamp(0, SIDE)
    return replace(images, images=images.images.roll(step, 3), boxes=boxes)

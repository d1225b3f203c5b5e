"""The named random streams of a run, each with a seed of its own, so that one more draw in one changes no other."""

from __future__ import annotations

import torch

STREAMS: dict[str, tuple[int, int]] = {
    # A run's trainings and its psi loop.
    "detector": (1_000_003, 1),  # images, new parameters and order of training of a detector
    "psi": (1_000_003, 2),  # everything that a method draws on its way to a psi
    "photographs": (1_000_003, 3),  # the order in which photographs are chosen to train on
    "fine-tuning": (1_000_003, 4),  # new parameters and order of a training on photographs alone
    # A target's images: the division of photographs into parts, or what a rendered target draws for each part.
    "target parts": (1, -1),
    "target val": (2_000_003, 0),
    "target test": (2_000_003, 1),
    "target train": (2_000_003, 2),
    # Streams of a psi loop, derived from its generator: random numbers shared by trainings that differ only in psi, and
    # those of the estimate from the target's boxes, which proposes the first step.
    "common images": (2_000_003, 0),
    "common training": (2_000_003, 1),
    "common first step": (2_000_003, 2),
}
"""Multiplier m and offset o of every stream, whose generator is seeded with m (seed + 1) + o.

Changing either changes results. No two streams without a parent share a generator for seeds below 300,000.
"""


def stream(seed: int, name: str, parent: torch.Generator | None = None) -> torch.Generator:
    """Make the generator of a named stream, on the CPU.

    Args:
        seed: the run's seed, or with a ``parent`` a count from 0.
        name: one of ``STREAMS``.
        parent: a generator whose initial seed is added.

    Raises:
        ValueError: ``STREAMS`` does not list the name.
    """
    if name not in STREAMS:
        raise ValueError(f"randomness: unknown stream {name!r}, want one of {', '.join(STREAMS)}")
    multiplier, offset = STREAMS[name]
    first = 0 if parent is None else parent.initial_seed()
    return torch.Generator().manual_seed(first + multiplier * (seed + 1) + offset)

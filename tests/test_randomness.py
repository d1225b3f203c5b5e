"""Random streams by name: each keeps its numbers, and none shares them with another."""

import itertools

import pytest
import torch

from neural_sim.randomness import STREAMS, stream

RUN = [name for name in STREAMS if name.partition(" ")[0] != "common"]


def test_streams_keep_their_seeds():
    """Literally, since a changed seed changes every result."""
    seeds = {name: stream(7, name).initial_seed() for name in STREAMS}
    assert seeds == {
        "detector": 8_000_025, "psi": 8_000_026, "photographs": 8_000_027, "fine-tuning": 8_000_028,
        "target parts": 7, "target val": 16_000_024, "target test": 16_000_025, "target train": 16_000_026,
        "common images": 16_000_024, "common training": 16_000_025, "common first step": 16_000_026,
    }  # fmt: skip


def test_a_parents_first_seed_is_added_whatever_was_drawn_from_it():
    parent = torch.Generator().manual_seed(100)
    torch.rand(3, generator=parent)
    assert stream(0, "common images", parent).initial_seed() == 100 + 2_000_003
    assert stream(2, "common training", parent).initial_seed() == 100 + 3 * 2_000_003 + 1


def test_no_two_streams_of_a_run_share_a_seed():
    seeds = [stream(seed, name).initial_seed() for seed, name in itertools.product(range(1000), RUN)]
    assert len(set(seeds)) == len(seeds)


def test_an_unknown_stream_is_refused():
    with pytest.raises(ValueError, match="unknown stream 'detectors', want one of detector, psi"):
        stream(0, "detectors")

"""The largest amount of memory that torch holds while something runs."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch.profiler import ProfilerActivity, profile

from neural_sim.devices import forget_gpu_peak

# Read when the profiler first runs, which otherwise writes lines of its own to the screen.
os.environ.setdefault("KINETO_LOG_LEVEL", "99")


def peak_bytes(run: Callable[[], object], device: torch.device | None = None) -> int:
    """Most bytes that tensors took at one time while ``run`` ran, beyond what they took before.

    On a CPU (the default) by the profiler's record of every allocation, on a GPU by the allocator's own count.

    Raises:
        RuntimeError: where the profiler recorded no allocation.
    """
    if device is not None and device.type == "cuda":
        before = torch.cuda.memory_allocated(device)
        forget_gpu_peak(device)
        run()
        return torch.cuda.max_memory_allocated(device) - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        run()
    current, most = 0, 0
    kineto = record.profiler.kineto_results if record.profiler is not None else None
    events = [event for event in kineto.events() if event.name() == "[memory]"] if kineto is not None else []
    if not events:
        raise RuntimeError("the profiler recorded no allocation")
    for event in sorted(events, key=lambda event: event.start_ns()):
        current += event.nbytes()  # pyright: ignore[reportAttributeAccessIssue]
        most = max(most, current)
    return most

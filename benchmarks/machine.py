"""Helpers shared by the benchmarks: the device option and memory measurements."""

from __future__ import annotations

import argparse
import re
import resource
from pathlib import Path

import torch

from neural_sim.devices import compute_in_float32, forget_gpu_peak


def add_device(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--device``: cpu, cuda or cuda:1, which compute as runs do."""
    compute_in_float32()
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="cpu or cuda")


def memory_mb() -> tuple[float, float]:
    """Return the resident memory of this process now and its peak since ``forget_peak``, in MB; Linux only."""
    status = Path("/proc/self/status")
    if not status.is_file():
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        return most, most
    found = dict(re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB$", status.read_text(), re.MULTILINE))
    return int(found["VmRSS"]) / 1024.0, int(found["VmHWM"]) / 1024.0


def forget_peak(device: torch.device | None = None) -> None:
    """Reset the peaks of ``memory_mb`` and of the GPU, if the system can."""
    if device is not None:
        forget_gpu_peak(device)
    if Path("/proc/self/clear_refs").is_file():
        Path("/proc/self/clear_refs").write_text("5")

"""What a timing depends on."""

from __future__ import annotations

import argparse
import os
import platform
import re
import resource
from pathlib import Path
from typing import Any

import torch


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option ``--device``: cpu, cuda or cuda:1."""
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="cpu or cuda")


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """Processor, cores, threads, load and versions, for a benchmark's JSON; the GPU's name and memory if it has one."""
    return gpu(device) | {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def gpu(device: torch.device | None) -> dict[str, Any]:
    """What a GPU is and the most memory that tensors held there since ``forget_peak``; nothing for a CPU."""
    if device is None or device.type != "cuda":
        return {} if device is None else {"device": device.type}
    held = torch.cuda.get_device_properties(device)
    return {
        "device": held.name,
        "gpu_mb": held.total_memory / 2**20,
        "peak_gpu_mb": torch.cuda.max_memory_allocated(device) / 2**20,
    }


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process now, and at most since ``forget_peak``; MB. Linux counts both."""
    status = Path("/proc/self/status")
    if not status.is_file():
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        return most, most
    found = dict(re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB$", status.read_text(), re.MULTILINE))
    return int(found["VmRSS"]) / 1024.0, int(found["VmHWM"]) / 1024.0


def forget_peak(device: torch.device | None = None) -> None:
    """Start the peaks of ``memory_mb`` and ``gpu`` anew, where the system can."""
    if device is not None and device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    if Path("/proc/self/clear_refs").is_file():
        Path("/proc/self/clear_refs").write_text("5")

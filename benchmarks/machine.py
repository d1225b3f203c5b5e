"""What a timing depends on."""

from __future__ import annotations

import os
import platform
import re
import resource
from pathlib import Path
from typing import Any

import torch


def machine() -> dict[str, Any]:
    """Processor, cores, threads, load and versions, for a benchmark's JSON."""
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process now, and at most since ``forget_peak``; MB. Linux counts both."""
    status = Path("/proc/self/status")
    if not status.is_file():
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        return most, most
    found = dict(re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB$", status.read_text(), re.MULTILINE))
    return int(found["VmRSS"]) / 1024.0, int(found["VmHWM"]) / 1024.0


def forget_peak() -> None:
    """Start the peak of ``memory_mb`` anew, where the system can."""
    if Path("/proc/self/clear_refs").is_file():
        Path("/proc/self/clear_refs").write_text("5")

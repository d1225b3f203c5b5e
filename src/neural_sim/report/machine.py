"""What a timing depends on."""

from __future__ import annotations

import os
import platform
from typing import Any

import torch


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """Processor, cores, threads, load and versions; the GPU's name and memory if it has one."""
    return gpu(device) | {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def gpu(device: torch.device | None) -> dict[str, Any]:
    """What a GPU is and the most memory that tensors held there since its peak was reset; nothing for a CPU."""
    if device is None or device.type != "cuda":
        return {} if device is None else {"device": device.type}
    held = torch.cuda.get_device_properties(device)
    return {
        "device": held.name,
        "gpu_mb": held.total_memory / 2**20,
        "peak_gpu_mb": torch.cuda.max_memory_allocated(device) / 2**20,
    }

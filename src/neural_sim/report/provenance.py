"""The provenance of results, in addition to their settings: the command, the commit of the code, the machine."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch

PACKAGE = Path(__file__).parents[1]
SMALLEST = "smoke"
"""The choice of ``scale`` that only checks that everything runs."""


@cache
def commit(package: Path = PACKAGE) -> str | None:
    """Return seven digits of the checkout's commit, with ``-dirty`` if tracked files differ from it.

    None if ``package`` is not tracked by git (for instance, installed in a folder of another project), or if git fails.
    """
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    return _git(package, "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        command = ["git", "-C", str(folder), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """Describe the machine, for timings: processor, threads, load, versions, and the GPU's name and memory if any."""
    return gpu(device) | {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def gpu(device: torch.device | None) -> dict[str, Any]:
    """Return a GPU's name, its memory, and the peak memory of tensors since the last reset.

    For a CPU, return only the device type.
    """
    if device is None or device.type != "cuda":
        return {} if device is None else {"device": device.type}
    held = torch.cuda.get_device_properties(device)
    return {
        "device": held.name,
        "gpu_mb": held.total_memory / 2**20,
        "peak_gpu_mb": torch.cuda.max_memory_allocated(device) / 2**20,
    }


@dataclass(frozen=True)
class Made:
    """How a run was made, for readers of its page.

    Args:
        command: the command that repeats it.
        scale: the choice of ``scale``; empty: not known.
        date: day and time of the report.
        machine: description of the machine, see the function ``machine``.
        shows: kind of test images, such as ``synthetic test images``.
    """

    command: str = ""
    scale: str = ""
    date: str = ""
    machine: Mapping[str, Any] = field(default_factory=dict)
    shows: str = "test images"

    @property
    def caution(self) -> str:
        """A warning to show before any score; empty if there is none."""
        return caution(self.scale)

    @property
    def where(self) -> str:
        """The machine in a few words."""
        if not self.machine:
            return ""
        device = self.machine.get("device", "cpu")
        name = self.machine["processor"] if device == "cpu" else device
        cores = self.machine["cores"]
        return f"{name}, {cores} core{'s' * (cores != 1)}"


def caution(scale: str) -> str:
    """Return a warning if scores at this scale mean nothing; empty for other scales."""
    return (
        f"A trial (scale={scale}): it shows that everything runs, but its scores mean nothing."
        if scale == SMALLEST
        else ""
    )

"""What results depend on besides their settings: the command, the commit of the code, and the machine."""

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
"""The choice of ``scale`` that tries that everything runs."""


@cache
def commit(package: Path = PACKAGE) -> str | None:
    """Return seven digits of the checkout's commit, with ``-dirty`` where tracked files differ from it.

    None where ``package`` is not tracked by git, as when it is installed into a folder of another project, and where
    git does not answer.
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
    """Return what a timing depends on: processor, threads, load, versions, and the GPU's name and memory if any."""
    return gpu(device) | {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def gpu(device: torch.device | None) -> dict[str, Any]:
    """Return a GPU's name and memory, and the most that tensors held since its peak was reset; nothing for a CPU."""
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
    """How a run was made, for whoever reads its page.

    Args:
        command: that makes it again.
        scale: the choice of ``scale``; empty: not known.
        date: day and time of the report.
        machine: see ``machine``.
        shows: what its test images are, such as ``synthetic test images``.
    """

    command: str = ""
    scale: str = ""
    date: str = ""
    machine: Mapping[str, Any] = field(default_factory=dict)
    shows: str = "test images"

    @property
    def caution(self) -> str:
        """What a reader must know before any score; empty if nothing."""
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
    """Say of a scale that its scores mean nothing; empty for all that are meant to be read."""
    return (
        f"A trial (scale={scale}): it shows that everything runs, and its scores mean nothing."
        if scale == SMALLEST
        else ""
    )

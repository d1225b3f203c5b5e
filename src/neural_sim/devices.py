"""Where a run computes: the one place that names a torch device, and the trainers that run on it.

Draws and psi, few numbers each, are made on the CPU by CPU generators, so that a seed draws the same scenes on every
device. Fields, images, features and targets live on the run's device; what leaves a stage comes back to the CPU once.
"""

from __future__ import annotations

import logging
import os
import resource
from collections.abc import Callable, Sequence

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.profiler import ProfilerActivity, profile
from typing_extensions import override

# Read when the profiler first runs, which otherwise writes lines of its own to the screen.
os.environ.setdefault("KINETO_LOG_LEVEL", "99")
# A line on SIGTERM, which `interruption` has said already.
logging.getLogger("lightning.pytorch.trainer.connectors.signal_connector").setLevel(logging.WARNING)

DEVICES = {"cpu": "cpu", "gpu": "cuda"}
"""torch's device type by ``trainer.accelerator``."""
CACHES = 32
"""How many times the work that fits a CPU's cache is handed to any other device at once."""


def device_of(accelerator: str) -> torch.device:
    """Return the device of ``trainer.accelerator``, set to compute as the CPU does, in full float32.

    Raises:
        ValueError: an unknown accelerator, or one this machine lacks.
    """
    if accelerator not in DEVICES:
        raise ValueError(f"trainer.accelerator must be one of {', '.join(DEVICES)}, got {accelerator!r}")
    kind = DEVICES[accelerator]
    if kind == "cpu":
        return torch.device(kind)
    if not torch.get_device_module(kind).is_available():
        raise ValueError(f"trainer={accelerator}: no {kind} device answers here; want trainer=cpu")
    compute_in_float32()
    return torch.device(kind, 0)


def compute_in_float32() -> None:
    """Keep a GPU from rounding what it convolves or multiplies to TF32's 11 bits, as torch lets cuDNN do by default.

    Derivatives of the psi loop are central differences of losses, whose digits that rounding takes: on an H200 their
    standard errors were 1.4 to 2.6 times the CPU's (docs/numerics.md).
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


class Resident(SingleDeviceStrategy):
    """One device, on which modules and optimisers stay, and whose memory stays with torch.

    Lightning's own moves each tensor to the CPU after a fit and frees what the allocator keeps for the next one.
    """

    @override
    def teardown(self) -> None:
        return


def trainer_on(device: torch.device, max_epochs: int = 1) -> Trainer:
    """Make a Trainer for modules that lie on ``device``, with everything off that writes files or talks.

    It leaves signals to ``interruption``: under SLURM it would otherwise ignore SIGTERM and requeue the job itself.
    """
    on_cpu = device.type == "cpu"
    return Trainer(
        accelerator=device.type,
        devices=1 if on_cpu else [device.index or 0],
        strategy="auto" if on_cpu else Resident(device),
        plugins=[LightningEnvironment()],
        max_epochs=max_epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


def at_once(on_cpu: int, device: torch.device) -> int:
    """Return the batch size ``on_cpu``, which fits a cache, or ``CACHES`` times that on a GPU, where launches cost."""
    return on_cpu if device.type == "cpu" else CACHES * on_cpu


def moved(tensors: Sequence[torch.Tensor], device: torch.device | str) -> list[torch.Tensor]:
    """Small tensors of one type on ``device``, in one copy."""
    if all(tensor.device == torch.device(device) for tensor in tensors):
        return list(tensors)
    together = torch.cat([tensor.reshape(-1) for tensor in tensors]).to(device)
    parts = together.split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def synchronise(device: torch.device) -> None:
    """Wait for the device, so that a clock read next has its work in it; nothing on a CPU."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize(device)


def peak_memory_mb(device: torch.device) -> dict[str, float]:
    """Most memory so far in MB: of the process (``peak_memory_mb``) and a GPU's tensors (``peak_gpu_memory_mb``)."""
    peaks = {"peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
    if device.type == "cuda":
        peaks["peak_gpu_memory_mb"] = torch.cuda.max_memory_allocated(device) / 2**20
    return peaks


def forget_gpu_peak(device: torch.device) -> None:
    """Start the count of ``peak_gpu_memory_mb`` anew; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.init()  # without which torch has no count to reset, and raises
        torch.cuda.reset_peak_memory_stats(device)


def peak_bytes(run: Callable[[], object], device: torch.device | None = None) -> int:
    """Measure the most bytes that tensors took at one time while ``run`` ran, beyond what they took before.

    On a CPU (the default) by the profiler's record of every allocation, on a GPU by the allocator's own count.

    Raises:
        RuntimeError: the profiler recorded no allocation.
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


def placed(tensors: dict[str, torch.Tensor], device: torch.device) -> dict[str, torch.Tensor]:
    """Return the tensors on ``device``; those that are there already are not copied."""
    return {name: tensor.to(device) for name, tensor in tensors.items()}

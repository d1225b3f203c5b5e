"""Choose the torch device of a run, which only this module does, and build the trainers that run on it.

Draws and psi, few numbers each, are made on the CPU by CPU generators, so that a seed draws the same scenes on every
device. Fields, images, features and targets live on the run's device; results are copied to the CPU to be stored.
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

# Read when the profiler first runs, which otherwise prints lines of its own.
os.environ.setdefault("KINETO_LOG_LEVEL", "99")
# Silences a line on SIGTERM, which `interruption` reports itself.
logging.getLogger("lightning.pytorch.trainer.connectors.signal_connector").setLevel(logging.WARNING)

DEVICES = {"cpu": "cpu", "gpu": "cuda"}
"""torch's device type by ``trainer.accelerator``."""
CACHES = 32
"""Batches on a GPU are this many times as large as those that fit a CPU's cache."""


def device_of(accelerator: str) -> torch.device:
    """Return the device of ``trainer.accelerator``, set to compute as the CPU does, in full float32.

    Raises:
        ValueError: the accelerator is unknown, or this machine lacks it.
    """
    if accelerator not in DEVICES:
        raise ValueError(f"trainer.accelerator must be one of {', '.join(DEVICES)}, got {accelerator!r}")
    kind = DEVICES[accelerator]
    if kind == "cpu":
        return torch.device(kind)
    if not torch.get_device_module(kind).is_available():
        raise ValueError(f"trainer={accelerator}: torch finds no {kind} device; want trainer=cpu")
    compute_in_float32()
    return torch.device(kind, 0)


def compute_in_float32() -> None:
    """Keep a GPU from rounding the inputs of convolutions and matrix products to TF32's 11 bits.

    torch allows that for convolutions by default. The psi loop takes central differences of losses, which lose digits
    by that rounding: on an H200 their standard errors were 1.4 to 2.6 times the CPU's (docs/numerics.md).
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


class Resident(SingleDeviceStrategy):
    """A strategy for one device that leaves modules, optimisers and cached memory on it after a fit.

    Lightning's own moves each tensor to the CPU and frees the memory that the allocator keeps for the next fit.
    """

    @override
    def teardown(self) -> None:
        return


def trainer_on(device: torch.device, max_epochs: int = 1) -> Trainer:
    """Make a Trainer for modules on ``device`` that writes no files and prints nothing.

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
    """Return the batch size ``on_cpu``, which fits a cache; ``CACHES`` times that on a GPU, to launch fewer kernels."""
    return on_cpu if device.type == "cpu" else CACHES * on_cpu


def moved(tensors: Sequence[torch.Tensor], device: torch.device | str) -> list[torch.Tensor]:
    """Copy small tensors of one dtype to ``device`` in one transfer."""
    if all(tensor.device == torch.device(device) for tensor in tensors):
        return list(tensors)
    together = torch.cat([tensor.reshape(-1) for tensor in tensors]).to(device)
    parts = together.split([tensor.numel() for tensor in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def synchronise(device: torch.device) -> None:
    """Wait until the device has finished, so that measured times include its work; does nothing on a CPU."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize(device)


def peak_memory_mb(device: torch.device) -> dict[str, float]:
    """Return the peaks so far in MB: ``peak_memory_mb`` of the process, ``peak_gpu_memory_mb`` of tensors on a GPU."""
    peaks = {"peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
    if device.type == "cuda":
        peaks["peak_gpu_memory_mb"] = torch.cuda.max_memory_allocated(device) / 2**20
    return peaks


def forget_gpu_peak(device: torch.device) -> None:
    """Reset ``peak_gpu_memory_mb``; does nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.init()  # before it, torch has nothing to reset and raises
        torch.cuda.reset_peak_memory_stats(device)


def peak_bytes(run: Callable[[], object], device: torch.device | None = None) -> int:
    """Measure the most bytes that tensors took at one time while ``run`` ran, beyond what they took before.

    The number comes from the profiler's record of all allocations on a CPU (the default), and from the allocator on a
    GPU.

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

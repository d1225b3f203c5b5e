"""A device that holds its tensors on the CPU, refuses what CUDA would refuse, and counts what would make a GPU wait.

``PrivateUse1`` is torch's place for a device of one's own. Here its tensors are wrappers round CPU tensors; below
autograd and function transforms every operation comes by ``_run``, which checks it by CUDA's rules, runs it on what is
wrapped, and keeps a ``Ledger``. What this cannot show: whether CUDA has a kernel for each type, seconds, memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._mode_utils import no_dispatch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend
from trips import Ledger, ledgers, place

NAME = "pretend"
aten = torch.ops.aten
BINARY = {
    "add", "add_", "sub", "sub_", "rsub", "mul", "mul_", "div", "div_", "true_divide", "floor_divide", "remainder",
    "fmod", "pow", "pow_", "atan2", "hypot", "logaddexp", "xlogy", "special_xlogy", "maximum", "minimum", "eq", "ne",
    "lt", "le", "gt", "ge", "bitwise_and", "bitwise_or", "logical_and", "logical_or", "where", "masked_fill",
    "masked_fill_", "fill_", "fill", "index_put", "index_put_", "_index_put_impl_",
}  # fmt: skip
"""Operations whose CUDA kernels take a CPU number (a tensor without dimensions) beside tensors on the device."""
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}
WAITING = {"_local_scalar_dense", "equal", "nms", "nonzero", "masked_select", "bincount", "_unique2", "unique_dim",
           "unique_consecutive", "_linalg_check_errors", "_linalg_eigh", "is_nonzero", "histc"}  # fmt: skip
"""Operations that return a number to the host, or whose result has a size that depends on values."""


class Mixture(RuntimeError):
    """An operation that a GPU would refuse."""


class PretendTensor(torch.Tensor):
    """A tensor that says it is on the device; ``raw`` holds its numbers."""

    raw: torch.Tensor
    __torch_function__ = (
        torch._C._disabled_torch_function_impl
    )  # else results on the CPU would get this class

    @staticmethod
    def __new__(cls, raw: torch.Tensor) -> PretendTensor:
        made = torch.Tensor._make_wrapper_subclass(
            cls, raw.shape, strides=raw.stride(), storage_offset=raw.storage_offset(), dtype=raw.dtype,
            device=torch.device(NAME, 0),
        )  # fmt: skip
        made.raw = raw
        return made

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})

    def tolist(self) -> Any:
        return self.cpu().tolist()  # torch's own refuses subclasses

    def __repr__(self, **_) -> str:
        return f"PretendTensor({self.raw})"


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = func.overloadpacket.__name__
    if name == "_efficientzerotensor":  # a tensor without data, which kernels below this do not know
        func, name = aten.zeros.default, "zeros"
    there: list[PretendTensor] = []
    here: list[torch.Tensor] = []
    drawn: list[torch.Generator] = []

    def unwrapped(x: Any) -> Any:
        if isinstance(x, PretendTensor):
            there.append(x)
            return x.raw
        if isinstance(x, torch.Tensor):
            here.append(x)
        elif isinstance(x, torch.Generator):
            drawn.append(x)
        elif isinstance(x, (list, tuple)):
            return type(x)(unwrapped(y) for y in x)
        return x

    raw, named = unwrapped(list(args)), {key: unwrapped(value) for key, value in kwargs.items()}
    device = kwargs.get("device")
    goes_there = bool(there) if device is None else torch.device(device).type == NAME
    if goes_there and drawn:
        raise Mixture(f"{func}: a CPU generator cannot draw on the device ({place()})")
    if goes_there or there:
        _check(func, name, args, kwargs.get("output_size"), there, here, goes_there)
    if device is not None:
        named["device"] = torch.device("cpu")
    made = func(*raw, **named)
    if (
        there and torch.Tag.inplace_view in func.tags
    ):  # squeeze_ and its like: the wrapper takes the new shape too
        with no_dispatch():
            func(*args, **kwargs)
    known = {id(x.raw): x for x in there}
    if name == "copy_":
        return known.get(id(made), made)
    return _wrapped(made, known) if goes_there else made


def _wrapped(made: Any, known: dict[int, PretendTensor]) -> Any:
    if isinstance(made, torch.Tensor):
        return known[id(made)] if id(made) in known else PretendTensor(made)
    if isinstance(made, (list, tuple)):
        return type(made)(_wrapped(x, known) for x in made)
    return made


def _check(
    func: Any, name: str, args: Any, sized: int | None, there: list, here: list, goes_there: bool
) -> None:
    """Raise what CUDA would raise; count what it would wait for."""
    if not ledgers:
        raise Mixture(f"{func}: outside of the pretended device's context")
    ledger = ledgers[-1]
    ledger.calls += 1
    if name in ("_to_copy", "copy_"):
        source = args[1] if name == "copy_" else args[0]
        target_there = isinstance(args[0], PretendTensor) if name == "copy_" else goes_there
        if isinstance(source, PretendTensor) != target_there:
            kind = "to_device" if target_there else "to_host"
            ledger.note(kind, name, source.numel() * source.element_size())
        return
    if here and there:
        _check_mixture(func, name, args, here, ledger)
    shapes = func is aten.repeat_interleave.Tensor and sized is None  # elsewhere it is a composite of this
    masks = name in INDEXING and any(
        x is not None and x.dtype in (torch.bool, torch.uint8) for x in (args[1] or ())
    )
    if name in WAITING or masks or shapes:
        ledger.note("wait", name)


def _check_mixture(func: Any, name: str, args: Any, here: list, ledger: Ledger) -> None:
    indices = [x for x in (args[1] or ()) if x is not None] if name in INDEXING else []
    for tensor in here:
        if any(tensor is x for x in indices) and isinstance(args[0], PretendTensor):
            ledger.note("to_device", name, tensor.numel() * tensor.element_size())
        elif tensor.ndim == 0 and name in BINARY and not (name.endswith("_") and tensor is args[0]):
            continue
        else:
            shape = tuple(tensor.shape)
            raise Mixture(f"{func}: a CPU tensor {shape} beside tensors on the device ({place()})")


def _accelerator() -> type:
    """What Lightning asks of a device; imported late, for it is slow to import."""
    from lightning.pytorch.accelerators import Accelerator

    class PretendAccelerator(Accelerator):
        def setup_device(self, device: torch.device) -> None:
            if device.type != NAME:
                raise ValueError(f"want a device of type {NAME}, got {device}")

        def get_device_stats(self, device: Any) -> dict[str, Any]:
            return {}

        def teardown(self) -> None:
            return

        @staticmethod
        def parse_devices(devices: Any) -> list[int]:
            return list(devices) if isinstance(devices, list) else list(range(int(devices)))

        @staticmethod
        def get_parallel_devices(devices: list[int]) -> list[torch.device]:
            return [torch.device(NAME, i) for i in devices]

        @staticmethod
        def auto_device_count() -> int:
            return 1

        @staticmethod
        def is_available() -> bool:
            return bool(ledgers)

        @staticmethod
        def name() -> str:
            return NAME

    return PretendAccelerator


class _Module(_DummyBackendModule):
    def is_available(self) -> bool:
        return bool(ledgers)

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return []

    def synchronize(self, device: Any = None) -> None:
        if ledgers:
            ledgers[-1].note("wait", "synchronize")


class _Hook(torch._C._acc.PrivateUse1Hooks):
    """Says no outside of the context, so that other tests of the process see a machine without accelerator."""

    def is_available(self) -> bool:
        return bool(ledgers)

    def has_primary_context(self, dev_id: int) -> bool:
        return bool(ledgers)

    def is_built(self) -> bool:
        return True


_library = torch.library.Library("aten", "IMPL")


def _never(*_: Any, **__: Any) -> Any:
    raise Mixture("a kernel of the pretended device was reached outside of its context")


def register() -> None:
    """Make the device known to torch, once a process and before its first backward pass, which counts the devices."""
    if not hasattr(torch, NAME):
        _setup_privateuseone_for_python_backend(NAME, _Module(), _Hook())
        # CPU and CUDA have kernels of their own where other devices get a formula, whose rounding is another. Any
        # kernel says that this one has, too; the mode stands before it.
        for name in ("silu_backward",):
            _library.impl(name, _never, "PrivateUse1")


def _register_with_lightning() -> None:
    from lightning.pytorch.accelerators import AcceleratorRegistry

    if NAME not in AcceleratorRegistry.available_accelerators():
        AcceleratorRegistry.register(NAME, _accelerator())


@contextmanager
def pretend_device() -> Iterator[Ledger]:
    """Within it ``torch.device("pretend")`` works; its trips are counted from here on."""
    register()
    _register_with_lightning()
    lifting = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device=...) then comes by _run
    ledgers.append(Ledger())
    try:
        with _Mode():
            yield ledgers[-1]
    finally:
        ledgers.pop()
        torch._C._set_only_lift_cpu_tensors(lifting)

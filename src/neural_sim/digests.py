"""Short digests of plain values and of tensors, for keys of stored results and for telling runs apart."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import torch


def digest(description: Mapping[str, Any]) -> str:
    """Return 20 hex digits of the SHA-256 of canonical JSON. Raises ``TypeError`` for values that JSON cannot hold."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def tensor_digest(tensors: Iterable[torch.Tensor]) -> str:
    """Return a digest of shapes, dtypes and values, for results whose inputs are tensors (such as psi)."""
    total = hashlib.sha256()
    for tensor in tensors:
        values = tensor.detach().cpu().contiguous()
        total.update(f"{values.dtype}{tuple(values.shape)}".encode())
        total.update(values.numpy().tobytes())
    return total.hexdigest()[:20]

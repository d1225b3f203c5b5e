"""Packages that only some inputs and outputs need: the extras of pyproject.toml."""

from __future__ import annotations

import importlib.util

PACKAGES = {
    "photos": ("pycolmap", "skimage"),
    "bop": ("h5py",),
    "onnx": ("onnx", "onnxscript", "onnxruntime"),
    "viewer": ("viser",),
    "video": ("av",),
}
"""The modules that each extra installs."""


def require(extra: str, what: str) -> None:
    """Refuse work whose packages are not installed.

    Args:
        extra: a key of ``PACKAGES``.
        what: what needs them, with which the message begins: a configuration key or a file.

    Raises:
        ValueError: for packages that are missing, with the command that installs them.
    """
    missing = [name for name in PACKAGES[extra] if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f"{what}: {', '.join(missing)} not installed; pip install 'neural-sim[{extra}]'")

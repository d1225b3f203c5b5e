"""Optional packages, needed for some inputs, outputs and ways to run only: the extras of pyproject.toml."""

from __future__ import annotations

import importlib.util
from contextlib import suppress

from neural_sim.configuration import UserError

PACKAGES = {
    "photos": ("pycolmap", "skimage"),
    "bop": ("h5py",),
    "onnx": ("onnx", "onnxscript", "onnxruntime"),
    "viewer": ("viser",),
    "video": ("av",),
    "ray": ("ray",),
    "sweeps": ("hydra_plugins.hydra_joblib_launcher", "hydra_plugins.hydra_submitit_launcher"),
}
"""The modules that each extra provides."""


def require(extra: str, what: str) -> None:
    """Refuse work whose packages are not installed.

    Args:
        extra: a key of ``PACKAGES``.
        what: the configuration key or file that needs them, for the beginning of the message.

    Raises:
        UserError: packages are missing; the message has the command that installs them.
    """
    if missing := missing_of(extra):
        raise UserError(f"{what}: {', '.join(missing)} not installed; pip install 'neural-sim[{extra}]'")


def missing_of(extra: str) -> list[str]:
    """Return the modules of an extra that are not installed."""
    return [name for name in PACKAGES[extra] if not _installed(name)]


def _installed(name: str) -> bool:
    with suppress(ModuleNotFoundError):  # raised if the parent package is missing
        return importlib.util.find_spec(name) is not None
    return False

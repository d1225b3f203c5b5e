"""Read psi from the files of a run or an export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neural_sim.documents import read_json
from neural_sim.parameter.product import SceneDistribution


def psi_of_file(
    path: Path, distribution: SceneDistribution, names: Sequence[str], key: str = "export.psi"
) -> Float[Tensor, "objects K"]:
    """Read psi from a run's folder or its ``results.json`` (the learned psi), or from an export's ``psi.json``.

    ``key`` is the setting that names the file.

    Raises:
        ValueError: the file does not exist, is of another kind, lacks an object or a factor, or has other bins.
    """
    file = path / "results.json" if path.is_dir() else path
    if not file.is_file():
        raise ValueError(
            f"{key}: want learned, initial, target, a run's folder, its results.json or an export's psi.json, got "
            f"{file}, which does not exist"
        )
    try:
        stored = read_json(file)["psi"]
        rows = [[_numbers(stored, name, factor.name) for factor in distribution.factors] for name in names]
    except KeyError as error:
        raise ValueError(
            f"{key}: {file} has no psi of {error.args[0]}; want objects {list(names)} with {list(distribution.names)}"
        ) from error
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{key}: {file} is not a results.json or psi.json ({error})") from error
    psi = []
    for name, row in zip(names, rows, strict=True):
        parts = []
        for factor, numbers in zip(distribution.factors, row, strict=True):
            p = torch.tensor(numbers, dtype=torch.float64)
            fits = (
                p.shape == (factor.size,) and bool(p.isfinite().all()) and abs(float(p.sum()) - 1.0) <= 1e-4
            )
            if not fits or (not factor.lights and bool((p < 0.0).any())):  # weights of lights may be negative
                want = f"{factor.size} {'numbers' if factor.lights else 'probabilities'} that add up to 1"
                raise ValueError(f"{key}: {file}: {name}.{factor.name}: want {want}, got {numbers}")
            parts.append(factor.psi_of(p, factor.closed(name)))
        psi.append(torch.cat(parts))
    return torch.stack(psi)


def _numbers(stored: Any, name: str, factor: str) -> list[float]:
    """Return the numbers of a factor from ``psi.json``, or the learned ones from ``results.json``."""
    if name not in stored:
        raise KeyError(name)
    if factor not in stored[name]:
        raise KeyError(f"{name}.{factor}")
    numbers = stored[name][factor]
    return [float(value) for value in (numbers["learned"] if isinstance(numbers, dict) else numbers)]

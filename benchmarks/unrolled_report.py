"""The tables of ``unrolled.py``."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

INTRODUCTION = """    python benchmarks/unrolled.py --objects {objects} --seeds {seeds} --part {part:g}{overrides}

`outer.adjoint=unrolled`: one iteration of `+experiment=pose_gap gap=uniform` at 64 px (`detector=tiny`, six
objects, 300 images, 12 epochs of AdamW), one thread, processor time of the process. A training takes
{training:.1f} s; in trainings, medians of {repeats}:

| what | trainings |
|---|---|
{costs}

States and gradients kept: {megabytes:.0f} MB. Relative error of the bins' mean scores of {first} against exact Hessian
products and every one of {per_bin} probes a bin scored in every step (few probes: root mean square over draws):

| what is saved | error |
|---|---|
{errors}

The response: the training repeated with {part:.0%} of an object's images drawn from one bin instead, under the same
random numbers. Correlation over the bins of the change in validation loss with its prediction by each derivative, means
over {seeds} seeds (in brackets: seed by seed); then the slope of the response by its prediction, 1 for the right size:

{responses}
"""


def centred(values: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """Values minus their mean: an offset common to all bins has no effect."""
    return values - values.mean()


def correlation(one: Tensor, other: Tensor) -> float:
    one, other = centred(one), centred(other)
    return float(one @ other / (one.norm() * other.norm()))


def slope_of(response: Tensor, predicted: Tensor) -> float:
    """Least-squares slope of the response by its prediction."""
    x = centred(predicted)
    return float(centred(response) @ x / x.square().sum())


def table(found: dict[str, dict[str, Any]]) -> str:
    names = list(found)
    lines = ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for way in next(iter(found.values()))["foretold"]:
        cells = []
        for name in names:
            true, told = torch.stack(found[name]["response"]), torch.stack(found[name]["foretold"][way])
            each = ", ".join(f"{correlation(a, b):.2f}" for a, b in zip(true, told, strict=True))
            true, told = true.mean(0), told.mean(0)
            cells.append(f"{correlation(true, told):.2f} ({each}); {slope_of(true, told):.2g}")
        lines.append(f"| {way} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def report(
    found: dict[str, dict[str, Any]],
    spent: dict[str, float],
    wrong: dict[str, float],
    settings: dict[str, Any],
) -> str:
    """All tables, with the command that makes them; ``settings`` are its arguments."""
    shown = [f" {key}" for key in settings["overrides"] if not key.startswith("paths.")]
    keys = ("seeds", "part", "repeats", "per_bin")
    return INTRODUCTION.format(
        objects=" ".join(settings["objects"]), overrides="".join(shown), first=settings["objects"][0],
        training=spent["seconds"], megabytes=spent["megabytes"],
        costs="\n".join(f"| {k} | {v:.2f} |" for k, v in spent.items() if k not in ("seconds", "megabytes")),
        errors="\n".join(f"| {key} | {value:.2g} |" for key, value in wrong.items()), responses=table(found),
        **{key: settings[key] for key in keys},
    )  # fmt: skip

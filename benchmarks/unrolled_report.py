"""The tables of ``unrolled.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

INTRODUCTION = """    python benchmarks/unrolled.py --object {object}{overrides}

`outer.adjoint=unrolled`: one iteration of `+experiment=pose_gap gap=uniform` at 64 px (`detector=tiny`, six
objects, {images} images, {epochs} epochs of AdamW), one thread, processor time of the process. A training takes
{training:.1f} s; in trainings, medians of {repeats}:

| what | trainings |
|---|---|
{costs}

The default way, for other trainings:

| training | trained numbers | steps | seconds | the derivative, in trainings | MB of states and gradients |
|---|---|---|---|---|---|
{others}

Relative error of the bins' mean scores of {object} against exact Hessian products and every one of {per_bin} probes a
bin scored in every step (few probes: root mean square over draws):

| what is saved | error |
|---|---|
{errors}
"""
SIZES = ("seconds", "megabytes", "numbers", "steps")


def centred(values: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """Values minus their mean: an offset common to all bins has no effect."""
    return values - values.mean()


def report(
    spent: Mapping[str, Mapping[str, float]],
    wrong: Mapping[str, float],
    settings: Mapping[str, Any],
    overrides: Sequence[str],
) -> str:
    """All tables, with the command that makes them; ``settings`` are its arguments and sizes."""
    first = next(iter(spent.values()))
    shown = [f" {key}" for key in overrides if not key.startswith("paths.")]
    others = [
        f"| {name} | {c['numbers']:,.0f} | {c['steps']:.0f} | {c['seconds']:.1f} | {c[settings['default']]:.2f} "
        f"| {c['megabytes']:.0f} |"
        for name, c in spent.items()
    ]
    return INTRODUCTION.format(
        overrides="".join(shown), training=first["seconds"], object=settings["object"], repeats=settings["repeats"],
        costs="\n".join(f"| {key} | {value:.2f} |" for key, value in first.items() if key not in SIZES),
        others="\n".join(others), per_bin=settings["per_bin"],
        images=settings["images"], epochs=settings["epochs"],
        errors="\n".join(f"| {key} | {value:.2g} |" for key, value in wrong.items()),
    )  # fmt: skip

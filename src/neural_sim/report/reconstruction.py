"""Fields and reconstructed meshes on views that neither has seen: the table and the figure of sfm_vs_nerf."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from neural_sim.report.figures import INK


@dataclass(frozen=True)
class HeldOut:
    """One object: the first held-out view, as it is (``view``) and by each source, over white; and each source's
    ``psnr``, ``psnr_foreground`` (dB) and ``ssim`` on all of them.
    """

    object: str
    images: Mapping[str, Float[Tensor, "h w 3"]]
    scores: Mapping[str, Mapping[str, float]]


def held_out_table(objects: Sequence[HeldOut]) -> str:
    """Markdown: PSNR of whole images and of the object's pixels, by object and their mean."""
    sources = list(objects[0].scores)
    lines = [
        "PSNR on held-out views in dB, whole images over white, and of the pixels that show the object.",
        "",
        "| object | " + " | ".join(f"{s} | {s}, object" for s in sources) + " |",
        "|---|" + "---|" * (2 * len(sources)),
    ]
    rows = {
        each.object: [each.scores[s][key] for s in sources for key in ("psnr", "psnr_foreground")]
        for each in objects
    }
    rows["mean"] = np.mean(list(rows.values()), 0).tolist()
    return "\n".join(
        [*lines, *(f"| {n} | " + " | ".join(f"{v:.1f}" for v in row) + " |" for n, row in rows.items())]
    )


def held_out_figure(objects: Sequence[HeldOut]) -> Figure:
    """A column for each object, a row for its view and for each source."""
    rows = list(objects[0].images)
    figure = Figure(figsize=(1.6 * len(objects) + 0.5, 1.75 * len(rows) + 0.5), layout="constrained")
    grid = figure.subplots(len(rows), len(objects), squeeze=False)
    for column, each in enumerate(objects):
        for line, name in enumerate(rows):
            axes = grid[line, column]
            axes.imshow(each.images[name].clamp(0.0, 1.0).cpu().numpy())
            axes.set(xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set_visible(False)
            if name in each.scores:
                axes.set_xlabel(f"{each.scores[name]['psnr']:.1f} dB", color=INK, fontsize=8)
        grid[0, column].set_title(each.object, color=INK, fontsize=9)
    for line, name in enumerate(rows):
        grid[line, 0].set_ylabel(name, color=INK, fontsize=9)
    figure.suptitle("A held-out view; PSNR over all of them", color=INK, fontsize=11)
    return figure

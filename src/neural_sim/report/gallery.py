"""Images drawn from learned distributions beside test images: the figures of `+experiment=samples_gallery`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from neural_sim.report import figures, tracking
from neural_sim.report.figures import INK
from neural_sim.types import LabelledImages


@dataclass(frozen=True)
class Samples:
    """One object: images by method, test images, and by method the total variation of each factor's learned
    distribution to the target's, None where the target's is unknown.
    """

    object: str
    images: Mapping[str, LabelledImages]
    test: LabelledImages
    distances: Mapping[str, Mapping[str, float] | None]


def samples_figure(samples: Samples, columns: int) -> Figure:
    """A panel for each method and one of test images, each of rows of ``columns`` images."""
    panels = {
        method: (images, _caption(samples.distances[method])) for method, images in samples.images.items()
    }
    panels["test images"] = (samples.test, "")
    heights = [0.4 + 1.05 * -(-len(images) // columns) for images, _ in panels.values()]
    total = sum(heights) + 0.35
    figure = Figure(figsize=(1.05 * columns + 0.2, total))
    top = total - 0.35
    for (name, (images, caption)), height in zip(panels.items(), heights, strict=True):
        axes = figure.add_axes((0.01, (top - height) / total, 0.98, (height - 0.4) / total))
        axes.imshow(_canvas(images, columns))
        axes.set_axis_off()
        axes.set_title(name + caption, loc="left", color=INK, fontsize=9)
        top -= height
    figure.suptitle(f"{samples.object}: images drawn from what was learned", color=INK, fontsize=11)
    return figure


def _caption(distances: Mapping[str, float] | None) -> str:
    parts = [f"{factor} {value:.2f}" for factor, value in (distances or {}).items()]
    return f" (total variation to the target: {', '.join(parts)})" if parts else ""


def _canvas(images: LabelledImages, columns: int) -> np.ndarray:
    """Images row by row with white gaps."""
    height, width = images.images.shape[-2:]
    gap, rows = max(1, width // 32), max(1, -(-len(images) // columns))
    canvas = np.ones((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), dtype=np.float32)
    for i, image in enumerate(images.images.clamp(0.0, 1.0).movedim(1, -1).cpu().numpy()):
        y, x = i // columns * (height + gap), i % columns * (width + gap)
        canvas[y : y + height, x : x + width] = image
    return canvas


def table(samples: Sequence[Samples]) -> str:
    """Markdown: distances by object and factor."""
    methods = list(samples[0].images)
    lines = [
        "Total variation of the learned distribution to the target's; figures/ has images of each.",
        "",
        "| object, factor | " + " | ".join(methods) + " |",
        "|---|" + "---|" * len(methods),
    ]
    for each in samples:
        factors = [factor for d in each.distances.values() for factor in d or {}]
        for factor in dict.fromkeys(factors):
            cells = [f"{(each.distances[method] or {})[factor]:.2f}" for method in methods]
            lines.append(f"| {each.object}, {factor} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def report_samples(
    samples: Sequence[Samples],
    columns: int,
    experiment: str,
    config: Mapping[str, Any],
    uri: str,
    folder: Path,
    begun: float,
) -> tracking.Run:
    """A figure for each object, samples_gallery.md and samples_gallery.json in ``folder``, and a run in MLflow that
    began at ``begun`` (seconds since 1970).
    """
    folder.mkdir(parents=True, exist_ok=True)
    for each in samples:
        figures.save(samples_figure(each, columns), folder / "figures" / f"{each.object}.png")
    text = table(samples)
    (folder / "samples_gallery.md").write_text(text + "\n")
    document = {
        each.object: {"images": {m: len(i) for m, i in each.images.items()}, "test": len(each.test),
                      "total_variation": dict(each.distances)}
        for each in samples
    }  # fmt: skip
    (folder / "samples_gallery.json").write_text(json.dumps(document, indent=1))
    print(text)
    metrics = {
        f"{each.object}/{factor}/{method}": value
        for each in samples
        for method, distances in each.distances.items()
        for factor, value in (distances or {}).items()
    }
    seed = str(config["seed"])
    named = uri, experiment, f"seed {seed}", {"seed": seed}
    return tracking.log_run(*named, tracking.flatten(config), metrics, {}, folder, begun)

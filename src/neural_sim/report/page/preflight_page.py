"""preflight.html: whether an optimisation is worth it, and how renders differ from the target."""

from __future__ import annotations

from pathlib import Path

import torch

from neural_sim.report.page import pictures, render
from neural_sim.report.page.weak_bins import by_object, weakest
from neural_sim.report.preflight import Preflight
from neural_sim.types import LabelledImages

FILE = "preflight.html"
SHOWN = 18


def write_preflight_page(
    report: Preflight, target: LabelledImages, synthesised: LabelledImages, folder: Path
) -> Path:
    """Write preflight.html; images of both sets, spread over them, are side by side."""
    sides = {
        called: pictures.labelled(
            images, torch.linspace(0, len(images) - 1, min(SHOWN, len(images))).long().tolist(), report.names
        )
        for called, images in (
            ("The target's validation images", target),
            ("Synthesised images", synthesised),
        )
    }
    largest = max((abs(gain) for f in report.foreseen for gain in f.by_bin), default=0.0) or 1.0
    path = folder / FILE
    text = render.page(
        "preflight.html", title=f"{report.experiment}: preflight", report=report, sides=sides, largest=largest,
        bins=by_object(report.bins), weak=weakest(report.bins), promising=report.promising,
    )  # fmt: skip
    path.write_text(text, encoding="utf-8")
    return path

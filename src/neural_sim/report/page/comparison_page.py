"""report.html of a comparison: who is ahead, by how much, at what cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from neural_sim.detector.metrics import IN_FULL
from neural_sim.report.costs import HEAD, NOTE, Costs, cells
from neural_sim.report.page import charts, render
from neural_sim.report.page.verdict import POINTS, interval, listed
from neural_sim.report.statistics import ONLY_AT_END, Comparison

FILE = "report.html"


@dataclass(frozen=True)
class Section:
    """One setting's comparison: its AP against cost drawn, how its runs differ from others of the setting, and the
    classes whose AP is compared, and what each method cost.
    """

    comparison: Comparison
    curves: Figure
    heading: str
    biased: Sequence[str]
    costs: Mapping[str, Costs]

    @property
    def chart(self) -> str:
        """The source of an ``<img>``."""
        return charts.data_uri(self.curves)

    @property
    def cost_rows(self) -> dict[str, list[str]]:
        """By method, under the heads of ``cost_head``."""
        return {method: cells(cost) for method, cost in self.costs.items()}

    @property
    def cost_head(self) -> list[str]:
        return [*(f"{column}, s" for column in HEAD), "MB", "images", "error of the gradient"]

    @property
    def cost_note(self) -> str:
        return NOTE

    @property
    def verdict(self) -> str:
        """One sentence: whom the reference is ahead of, and whom not."""
        return verdict(self.comparison)

    @property
    def warning(self) -> str:
        """What the scores at fewer seconds do not tell; empty if they do."""
        return ONLY_AT_END if self.comparison.only_at_end else ""

    @property
    def in_full(self) -> str:
        """The score's name."""
        return IN_FULL[self.comparison.score]

    @property
    def longest(self) -> float:
        """The largest AP of the table, to which bars are drawn."""
        return max((estimate.value for estimate in self.comparison.ap.values()), default=1.0) or 1.0


def verdict(comparison: Comparison) -> str:
    """Whom the reference method is ahead of by AP at the end, with intervals; methods whose interval includes 0 are
    named as not told apart. Of one seed it says that intervals leave out how much trainings differ.
    """
    c = comparison
    reached = c.ap[c.reference]
    head = f"{c.reference} reaches {100 * reached.value:.1f} {POINTS[c.score]} ({interval(reached)})"
    groups = {
        "ahead of": [m for m, e in c.ahead.items() if e.certain and e.value > 0.0],
        "behind": [m for m, e in c.ahead.items() if e.certain and e.value < 0.0],
    }
    parts = []
    for word, methods in groups.items():
        if methods:
            parts.append(f"{word} " + listed([f"{m} by {abs(100 * c.ahead[m].value):.1f}" for m in methods]))
    untold = [m for m, e in c.ahead.items() if not e.certain]
    if untold:
        parts.append(f"not told apart from {listed(untold)}")
    one = "; one seed, so that how much trainings differ is not in this" if len(c.seeds) == 1 else ""
    return head + "".join(f", {part}" for part in parts) + one + "."


def write_comparison_page(sections: Sequence[Section], left_out: dict[str, list[str]], folder: Path) -> Path:
    """Write report.html. ``left_out`` are the runs that were not compared, by the reason."""
    path = folder / FILE
    title = "Comparison: " + ", ".join(section.comparison.setting for section in sections)
    path.write_text(
        render.page("comparison.html", title=title, sections=sections, left_out=left_out), encoding="utf-8"
    )
    return path

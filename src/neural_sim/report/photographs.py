"""AP by how many photographs train and how (the paper's Table 2): rows are ways of training, columns numbers of
photographs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neural_sim.report.compare import points
from neural_sim.report.intervals import Estimate
from neural_sim.report.object_scores import MEAN, called
from neural_sim.report.settings import Setting

NONE = "none"
WAYS = {NONE: "synthetic alone", "pretrain": "synthetic, then photographs", "combined": "both together"}
"""By ``training.real.mode``, in the order of a table's rows."""
ALONE = {"real_only": "photographs alone", "views_only": "views of the fields alone"}
"""By detector, first in a table."""


def asked(setting: Setting) -> tuple[float, str]:
    """How many photographs a setting asks for, as a number to sort by and in words.

    Numbers and fractions are of the configuration; how many there were of them, where that is fewer, is beside it.
    """
    real, trained = _real(setting), [run.results["real"].get("photographs", 0) for run in setting.runs]
    fewest, most = min(trained), max(trained)
    used = f"{most}" if fewest == most else f"{fewest} to {most}"
    if real["count"] is not None:
        fewer = f" ({used} at hand)" if fewest < real["count"] else ""
        return real["count"], f"{real['count']} photographs{fewer}"
    fraction = 1.0 if real["fraction"] is None else real["fraction"]
    return fraction, f"{100 * fraction:g} % of the photographs ({used})"


def _real(setting: Setting) -> Mapping[str, Any]:
    return setting.runs[0].results["config"]["training"]["real"]


def photographs_table(settings: Sequence[Setting]) -> str:
    """Mean AP of the biased objects in points, with 95 % intervals."""
    columns = sorted({asked(setting) for setting in settings})
    rows: dict[str, dict[str, Estimate]] = {}
    for setting in sorted(settings, key=_rank):
        number, scores = asked(setting)[1], setting.scores
        for which, row in ALONE.items():
            if which in scores.ap:
                rows.setdefault(row, {})[number] = scores.ap[which][MEAN]
        for method in scores.methods:
            if method != "matched":
                rows.setdefault(f"{WAYS[_mode(setting)]}, {called(method)}", {})[number] = scores.ap[method][
                    MEAN
                ]
    lines = ["| mAP | " + " | ".join(text for _, text in columns) + " |", "|" + "---|" * (1 + len(columns))]
    for name in sorted(rows, key=lambda row: row not in ALONE.values()):
        cells = [points(rows[name][text]) if text in rows[name] else "" for _, text in columns]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def _rank(setting: Setting) -> tuple[int, int]:
    """Settings of all methods come first, so that methods are in one order."""
    return list(WAYS).index(_mode(setting)), -len(setting.scores.methods)


def _mode(setting: Setting) -> str:
    """``none`` also where no photograph trained."""
    return setting.runs[0].results["real"].get("mode", NONE)


def photographs_summary(settings: Sequence[Setting]) -> list[str]:
    """NSO beside NS and photographs alone, for each setting."""
    lines = []
    for setting in sorted(settings, key=asked):
        scores = setting.scores
        seeds = ", ".join(map(str, scores.seeds))
        alone = (
            f"; photographs alone {points(scores.ap['real_only'][MEAN])}" if "real_only" in scores.ap else ""
        )
        ahead = [f"{called(m)} by {points(own[MEAN])}" for m, own in scores.ahead.items() if m != "matched"]
        lines.append(
            f"{asked(setting)[1]}, {WAYS[_mode(setting)]}, seeds {seeds}: NSO "
            f"{points(scores.ap[scores.reference][MEAN])}; ahead of {', '.join(ahead)}{alone}"
        )
    return lines

"""The tables of ``foretold.py``."""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import fmean
from typing import Any

WAYS = ("unrolled", "unrolled, no floor", "implicit", "dL_val/dtheta alone")
SEEDS = "unrolled, two seeds"
CLEAR = 0.7
"""The correlation of two seeds' responses from which on the response is a signal."""

INTRODUCTION = """    python benchmarks/foretold.py{arguments}

The response of training itself: 15% of an object's images drawn from one bin instead, the same training again, all
other random numbers the same; the change of the object's smooth AP, bin by bin. Beside it what the derivatives of the
outer objective foretell, through the training that was run and at a stationary point. Correlations over the bins, where
a loop starts, after the first step that its checks kept, and where it ends; means over loops (seeds {seeds}) with
{repeats} seeds of trainings each. *Two seeds*: of the response with itself under other random numbers. *Unrolled, two
seeds*: of the unrolled derivative with itself, whose remaining part is peculiar to one training.

{table}

Where two seeds of the response agree to {clear}, {count} of {total} places: {agreeing}. Elsewhere, mostly where there
is little left to gain: {rest}. *No floor*: the exact derivative, `outer.unrolled.floor=0`.
"""

Row = dict[str, Any]


def mean(rows: list[Row], key: str) -> float:
    known = [row[key] for row in rows if not math.isnan(row[key])]
    return fmean(known) if known else math.nan


def table(rows: list[Row]) -> str:
    keys = ("two seeds", SEEDS, *WAYS)
    lines = ["| | " + " | ".join(keys) + " |", "|---" * (len(keys) + 1) + "|"]
    cells: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        cells.setdefault((row["experiment"], row["place"], row["object"]), []).append(row)
    for (experiment, place, name), found in cells.items():
        numbers = [f"{mean(found, key):.2f}" for key in keys]
        lines.append(f"| {experiment}, {place}: {name} | " + " | ".join(numbers) + " |")
    return "\n".join(lines)


def report(rows: list[Row], settings: dict[str, Any]) -> str:
    """The section's text; ``settings`` are the command's arguments."""

    def where(clear: Callable[[float], bool]) -> list[Row]:
        return [row for row in rows if clear(row["two seeds"])]

    def each(rows: list[Row]) -> str:
        return "; ".join(f"{way} {mean(rows, way):.2f}" for way in WAYS)

    clear, rest = where(lambda value: value >= CLEAR), where(lambda value: value < CLEAR)
    shown = [key for key in settings["overrides"] if not key.startswith("paths.")]
    lists = {"experiments": settings["experiments"], "seeds": map(str, settings["seeds"])}
    # Overrides come first: a list takes all that follows it.
    command = "".join(f" --{key} {' '.join(values)}" for key, values in lists.items())
    return INTRODUCTION.format(
        arguments="".join(f" {key}" for key in shown) + command,
        seeds=", ".join(map(str, settings["seeds"])), repeats=settings["repeats"], table=table(rows), clear=CLEAR,
        count=len(clear), total=len(rows), agreeing=each(clear), rest=each(rest),
    )  # fmt: skip

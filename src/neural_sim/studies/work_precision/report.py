"""The output of ``+experiment=work_precision``: a document, tables, figures, and sections of a documentation page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from neural_sim.documents import finite, markdown_table, read_json, replace_section, write_json
from neural_sim.report import figures
from neural_sim.report.tracking import Run
from neural_sim.studies.work_precision.measurement import Point, Series
from neural_sim.tasks.context import Context

INTRODUCTION = (
    "{clock} of {processor} with torch {torch} and {threads} thread(s), load {load:.1f}. A setting is *optimal* if "
    "every other one in the table has a larger error or takes longer. MB is the peak memory of tensors."
)
MACHINE = "{clock} of {processor}, torch {torch}, {threads} thread(s), load {load:.1f}."
SECTION = "<!-- begin: Error against run time: "
CLOCKS = {"cpu_seconds": "CPU seconds", "seconds": "Wall-clock seconds"}
Row = Mapping[str, Any]


def document(series: Sequence[Series], machine: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of work_precision.json; undefined numbers are null.

    It has one row per setting under ``series``, the observed orders, notes on what was measured, and the defaults that
    are not Pareto-optimal.
    """
    rows, orders, overtaken = [], [], []
    for each in series:
        for point, best in zip(each.points, each.pareto, strict=True):
            rows.append({"name": each.name, "error_kind": each.error_kind, **asdict(point), "pareto": best})
        orders += [{"name": each.name, **asdict(order)} for order in each.orders]
        overtaken += [
            {"name": each.name, "default": mine.setting, "by": other.setting,
             "error_ratio": _ratio(mine.error, other.error), "seconds_ratio": _ratio(mine.seconds, other.seconds)}
            for mine, other in each.overtaken()
        ]  # fmt: skip
    measured = {each.name: {"clock": each.clock, "note": each.note} for each in series}
    return finite({
        "machine": machine, "measured": measured, "series": rows, "orders": orders, "overtaken": overtaken,
        "notes": [],
    })  # fmt: skip


def _ratio(mine: float, other: float) -> float | None:
    return mine / other if other > 0.0 else None


def markdown(held: Mapping[str, Any], family: str) -> str:
    """Return the tables and observed orders of one family, from the content of the JSON file."""
    names = _names(held, family)
    clock = CLOCKS[held["measured"][names[0]]["clock"]]
    parts = [INTRODUCTION.format(clock=clock, **held["machine"])]
    for name in names:
        rows = [row for row in held["series"] if row["name"] == name]
        parts += [f"**{name.partition('/')[2]}.** {held['measured'][name]['note']}", _table(rows)]
        parts += [_order(order) for order in held["orders"] if order["name"] == name]
        parts += [_overtaken(each) for each in held["overtaken"] if each["name"] == name]
    return "\n\n".join(parts)


def brief(held: Mapping[str, Any], family: str) -> str:
    """Return a short table for a family: each series' default, and the setting nearest in time on every other line.

    Series without a default are left out if others have one. For series without other lines, the Pareto-optimal
    settings are shown. A note shared by several series appears once.
    """
    names = _names(held, family)
    decided = [name for name in names if any(row["default"] for row in held["series"] if row["name"] == name)]
    names = decided or names
    parts = [MACHINE.format(clock=CLOCKS[held["measured"][names[0]]["clock"]], **held["machine"])]
    cells, orders, noted = [], [], ""
    for name in names:
        called, note = name.partition("/")[2], held["measured"][name]["note"]
        parts += [f"*{called}*: {note}"] if note and note != noted else []
        noted = note
        rows = _telling([row for row in held["series"] if row["name"] == name])
        shown = (
            "<br>".join(_short(row) for row in rows if row["default"] is default) for default in (True, False)
        )
        cells.append([f"{called}: {rows[0]['error_kind']}", *shown])
        orders += [
            f"{called}, {o['line']} {_observed(o)} ({o['theory']:g})"
            for o in held["orders"]
            if o["name"] == name
        ]
    parts.append(markdown_table(["error", "default", "others"], cells))
    parts += [f"Observed orders of convergence (in theory): {'; '.join(orders)}."] if orders else []
    parts += [_overtaken(each) for each in held["overtaken"] if each["name"].partition("/")[0] == family]
    return "\n\n".join(parts)


def _names(held: Mapping[str, Any], family: str) -> list[str]:
    return [name for name in held["measured"] if name.partition("/")[0] == family]


def _short(row: Row) -> str:
    detail = f" ({row['detail']})" if row["detail"] and row["default"] else ""
    return f"**{row['setting']}**: {_shown(row['error'])} in {_shown(row['seconds'])} s{detail}"


def _telling(rows: Sequence[Row]) -> list[Row]:
    own = next((row for row in rows if row["default"]), None)
    lines: dict[str, list[Row]] = {}
    for row in rows:
        if own and row["line"] != own["line"] and row["seconds"]:
            lines.setdefault(row["line"], []).append(row)
    if own is None or not own["seconds"] or not lines:
        return [row for row in rows if row["pareto"] or row["default"]] or list(rows)
    spent = own["seconds"]
    nearest = (min(of, key=lambda row: abs(math.log(row["seconds"] / spent))) for of in lines.values())
    return [own, *nearest]


def _named(row: Row) -> str:
    return f"**{row['setting']}** (default)" if row["default"] else row["setting"]


def _observed(order: Row) -> str:
    return "none" if order["observed"] is None else f"{order['observed']:.2f}"


def _table(rows: Sequence[Row]) -> str:
    detailed = any(row["detail"] for row in rows)
    cells = [
        [
            _named(row),
            _shown(row["error"]),
            _shown(row["seconds"]),
            "" if row["memory_mb"] is None else f"{row['memory_mb']:.3g}",
            "yes" if row["pareto"] else "",
            *([row["detail"]] if detailed else []),
        ]
        for row in rows
    ]
    head = ["setting", rows[0]["error_kind"], "seconds", "MB", "optimal", *([""] if detailed else [])]
    return markdown_table(head, cells)


def _shown(value: float | None) -> str:
    if value is None:
        return "not a number"
    return f"{value:.0f}" if 100.0 <= value < 1e5 else f"{value:.2g}"


def _order(order: Row) -> str:
    return (
        f"Order of {order['line']} for steps of {order['steps']}: {_observed(order)}, "
        f"in theory {order['theory']:g}."
    )


def _overtaken(each: Row) -> str:
    ratio = each["error_ratio"]
    if ratio is None:
        less = "no error"
    elif ratio < 1.01:
        less = "the same error"
    else:
        less = f"{1.0 - 1.0 / ratio:.0%} less error" if ratio < 2.0 else f"{ratio:.2g} times less error"
    faster = (
        f"takes {1.0 / each['seconds_ratio']:.2f} of the time" if each["seconds_ratio"] else "takes no time"
    )
    return f"The default, {each['default']}, is not Pareto-optimal: {each['by']} has {less} and {faster}."


def figure(series: Series) -> Figure:
    """Draw error against run time on logarithmic axes; an error of 0 is drawn at the lower edge.

    Lines join settings that differ in one number, Pareto-optimal settings are filled, and a ring marks the default.
    """
    made = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = made.add_subplot()
    shown = [p for p in series.points if math.isfinite(p.error) and p.seconds > 0.0]
    least = 0.3 * min((point.error for point in shown if point.error > 0.0), default=1.0)
    for number, line in enumerate(dict.fromkeys(point.line for point in shown)):
        _draw_line(axes, series, [point for point in shown if point.line == line], number, least)
    for point in shown:
        if point.default:
            at = (point.seconds, max(point.error, least))
            axes.plot(*at, "o", markersize=12, markerfacecolor="none", color=figures.INK)
            axes.annotate(f"default: {point.setting}", at, xytext=(9, 7), textcoords="offset points", fontsize=7,
                          color=figures.INK)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel=f"{CLOCKS[series.clock].lower()} (log)",
             ylabel=f"{series.error_kind} (log)")  # fmt: skip
    axes.set_title(series.name.replace("/", ": "), fontsize=10, color=figures.INK)
    axes.grid(color=figures.GRID)
    axes.set_axisbelow(True)
    figures.style(axes)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if high < 100.0 * low:  # powers of ten alone would give fewer than two labels
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0),
                title="filled: optimal", title_fontsize=7)  # fmt: skip
    return made


def _draw_line(axes: Any, series: Series, points: Sequence[Point], number: int, least: float) -> None:
    """Draw the settings of one line, filling the optimal ones."""
    colour = figures.CLASS_COLOURS[number % len(figures.CLASS_COLOURS)]
    marker = "os^Dvp*X"[number // len(figures.CLASS_COLOURS) % 8]
    best = dict(zip((p.setting for p in series.points), series.pareto, strict=True))
    x, y = [p.seconds for p in points], [max(p.error, least) for p in points]
    axes.plot(x, y, "-", color=colour, linewidth=1, alpha=0.6)
    for filled in (True, False):
        chosen = [(a, b) for a, b, p in zip(x, y, points, strict=True) if best[p.setting] is filled]
        if chosen:
            face = colour if filled else "white"
            axes.plot(*zip(*chosen, strict=True), marker, color=colour, markerfacecolor=face, markersize=5)
    label = points[0].line or "settings"
    axes.plot([], [], f"{marker}-", color=colour, markersize=5, linewidth=1, label=label)


def slug(name: str) -> str:
    """Return the name of a series as a file name."""
    return "".join(letter if letter.isalnum() else "_" for letter in name).replace("__", "_").strip("_")


def text_of(held: Mapping[str, Any]) -> str:
    """Return work_precision.md, from the content of the JSON file."""
    sections = [f"## {family}\n\n{markdown(held, family)}" for family in _families(held)]
    return "\n\n".join(["# Error against run time", *sections])


def _families(held: Mapping[str, Any]) -> list[str]:
    return list(dict.fromkeys(name.partition("/")[0] for name in held["measured"]))


def write_docs(held: Mapping[str, Any], page: Path, command: str) -> None:
    """Rewrite the sections of ``page`` (``documents.replace_section``); a page without sections gets all families.

    The page has the ``brief`` tables, and the JSON file of the same name the full tables of every family.
    """
    file = page.with_suffix(".json")
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    whole = read_json(file) if file.is_file() else {}
    for family in _families(held):
        name = f"Error against run time: {family}"
        if f"{SECTION}{family} -->" in text or SECTION not in text:
            replace_section(page, name, f"    {command}\n\n{brief(held, family)}")
        whole[family] = markdown(held, family)
    write_json(file, whole)


def publish(context: Context, series: Sequence[Series], held: Mapping[str, Any]) -> Run | None:
    """Write work_precision.json, work_precision.md and a figure per series, and log the defaults to MLflow."""
    metrics = {}
    for each in series:
        name = slug(each.name)
        for point in each.points:
            if point.default:
                metrics |= {f"{name}/default_error": point.error, f"{name}/default_seconds": point.seconds}
        metrics[f"{name}/defaults_not_optimal"] = float(len(list(each.overtaken())))
        metrics |= {f"{name}/order_{slug(order.line)}": order.observed for order in each.orders}
    drawn = {slug(each.name): figure(each) for each in series}
    return context.publish("work_precision", held, text_of(held), drawn, metrics)

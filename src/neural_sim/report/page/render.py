"""Render templates and figures as the text of a page."""

from __future__ import annotations

import base64
import io
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined

from neural_sim.report.figures import Figure

_pages = Environment(
    loader=PackageLoader("neural_sim.report.page"),
    autoescape=True,
    undefined=StrictUndefined,  # a name that a template misspells is an error, not an empty line
    trim_blocks=True,
    lstrip_blocks=True,
)


def percent(value: float | None, digits: int = 1) -> str:
    """Write a fraction in points; a dash for no value."""
    return "–" if value is None or value != value else f"{100.0 * value:z.{digits}f}"


def capital(text: str) -> str:
    """Write a text with a capital first letter; unlike ``str.capitalize``, keep the case of the rest (AP)."""
    return text[:1].upper() + text[1:]


_pages.filters |= {"percent": percent, "whole": partial(percent, digits=0), "capital": capital}


def page(template: str, **values: Any) -> str:
    """Fill the named template with values."""
    return _pages.get_template(template).render(**values)


def png_uri(path: Path) -> str | None:
    """Return a PNG file as the source of an ``<img>``; None if there is no such file."""
    if not path.is_file():
        return None
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def data_uri(figure: Figure) -> str:
    """Return a figure as the source of an ``<img>``: an SVG whose text stays text.

    Figures are embedded as separate images so that their SVG ids cannot clash.
    """
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "neural-sim"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()

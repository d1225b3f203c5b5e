"""Templates to text."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

_pages = Environment(
    loader=PackageLoader("neural_sim.report.page"),
    autoescape=True,
    undefined=StrictUndefined,  # a name that a template misspells is an error, not an empty line
    trim_blocks=True,
    lstrip_blocks=True,
)


def percent(value: float | None) -> str:
    """A fraction in points with one decimal; a dash for no value."""
    return "–" if value is None or value != value else f"{100.0 * value:.1f}"


def capital(text: str) -> str:
    """With a first capital; the rest stays, as in AP."""
    return text[:1].upper() + text[1:]


_pages.filters |= {"percent": percent, "capital": capital}


def page(template: str, **values: Any) -> str:
    """The named template with these values."""
    return _pages.get_template(template).render(**values)

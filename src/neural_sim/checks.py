"""Checks of settings that many constructors make."""

from __future__ import annotations


def at_least(where: str, smallest: float, **values: float) -> None:
    """Raises ``ValueError`` for a value below ``smallest``, by its key in the node ``where``."""
    for name, value in values.items():
        if not value >= smallest:
            raise ValueError(f"{where}.{name} must be at least {smallest}, got {value}")

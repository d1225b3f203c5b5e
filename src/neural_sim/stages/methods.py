"""Several methods within one run: the same command with each ``baseline=...``, on one store."""

from __future__ import annotations

from collections.abc import Sequence

from neural_sim.stages.graph import Graph
from neural_sim.tasks.context import Context


def graphs_of_methods(context: Context, methods: Sequence[str], key: str) -> dict[str, Graph]:
    """The stages of every method's experiment; all are built here, so that a bad choice is refused before any runs.

    Raises:
        ValueError: no method, or one that there is not; ``key`` is the setting's name. A context that cannot compose.
    """
    if context.of_method is None:
        raise ValueError(f"{key}: this context composes no other method's configuration")
    return {method: Graph(context.of_method(method)) for method in methods}


def check_methods(methods: Sequence[str], key: str) -> None:
    """Raises ``ValueError`` for no method, or for one that is named twice."""
    if not methods or len(set(methods)) < len(methods):
        raise ValueError(f"{key}: want different names of baselines, got {list(methods)}")

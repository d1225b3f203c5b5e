"""Whose code a result depends on: for the keys of stored results, and for which runs can be compared."""

from __future__ import annotations

DISTRIBUTIONS = tuple(
    f"parameter/{name}"
    for name in ("bins", "distributions", "factor", "illumination", "pose", "product", "zoom")
)
"""What draws scenes; how psi steps (``parameter/update``) matters to the psi loop alone."""

MESHES_DRAWN = (
    "objects",
    *(f"renderer/{name}" for name in ("mesh", "raycast", "surface", "lighting", "rig")),
)
"""What draws images from meshes."""

VIEWS = (*MESHES_DRAWN, "renderer/views", "cameras")
FIELDS = ("field", "renderer/nerf", "cameras")
TARGETS = (*MESHES_DRAWN, "target", "synthesis", *DISTRIBUTIONS)
DETECTORS = ("field", "renderer/nerf", "renderer/nerf_w", *DISTRIBUTIONS, "synthesis", "detector", "cameras")
"""What draws a training set from psi, trains a detector on it and scores it."""
LOOPS = ("outer", "gradient", "solver", "baseline", "methods", "parameter/update")
"""What moves psi."""
SCORING = tuple(sorted({*VIEWS, *FIELDS, *TARGETS, *DETECTORS}))
"""All that AP depends on beside psi."""

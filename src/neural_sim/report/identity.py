"""Decide which runs are comparable, by digests of their scoring, of all their settings, and of their test sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neural_sim.digests import digest, tensor_digest
from neural_sim.report.provenance import commit
from neural_sim.report.tracking import flatten
from neural_sim.types import LabelledImages

KEYS = ("scoring", "configuration", "test_set")
"""Digests in results.json, see ``identity``."""
SCORED = ("views", "field", "renderer", "synthesis", "unlearned", "target", "camera", "detector", "training")
"""Groups of the configuration on which a detector's AP depends, whichever method chose its training distribution."""
METHOD_KEYS = ("floor", "temperature", "bin_mean", "deviation", "constraint")
"""Keys of ``parameter.*`` and ``synthesis`` that say how a method draws, steps and differentiates; the others define
the initial distribution and the target's."""
RUN_KEYS = (
    "seed", "score_at", "stages", "progress", "resume", "workers", "worker_gpus", "paths", "trainer", "model",
    "preflight", "repeat", "predict", "export", "box", "viewer", "doctor",
)  # fmt: skip
"""Keys that may differ between runs of the same settings: how a run is executed, and what else is made of it."""
STUDY = "work_precision."
"""Prefix of the budget's keys that only a study reads, and no run."""
SHOWN = 3
"""Number of differences that are named; the others are counted."""


def identity(
    config: Mapping[str, Any], files: Mapping[str, Any], code: Mapping[str, str], test: LabelledImages
) -> dict[str, Any]:
    """Return the part of results.json that identifies a run for comparisons.

    Args:
        config: the resolved configuration.
        files: digests of the files that the run reads: ``objects`` by name in their order, and files of other groups.
        code: versions of the code: ``scoring`` trains and scores a detector, ``method`` moves psi.
        test: the test set.

    Returns:
        ``scoring``: digest of everything that must be equal for the AP of two methods to be comparable;
        ``configuration``: digest of the method's code and all settings but ``RUN_KEYS``, the same for all of a method's
        seeds; ``test_set``: digest of the test images and labels; ``config``, ``files`` and ``code``, to report
        differences; and the ``commit`` of the code, None outside a checkout.
    """
    scored = {"config": scored_config(config), "files": files, "names": list(files["objects"])}
    settings = {key: value for key, value in config.items() if key not in RUN_KEYS}
    return {
        "scoring": digest({**scored, "code": code["scoring"]}),
        "configuration": digest({"config": settings, "code": code["method"]}),
        "test_set": tensor_digest([test.images, test.boxes, test.labels]),
        "config": dict(config),
        "files": dict(files),
        "code": dict(code),
        "commit": commit(),
    }


def at_scale(then: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Check that all budget keys of a run match the present ones, see ``scale_of``; keys added later are ignored.

    Args:
        then: the run's budget.
        now: the present budget.
    """
    had, have = scale_of(then), scale_of(now)
    return bool(had) and had.items() <= have.items()


def scale_of(budget: Mapping[str, Any]) -> dict[str, str]:
    """Return the keys of a budget that runs depend on, with values as text, as MLflow stores them."""
    values = {key: str(value) for key, value in flatten(budget).items()}
    return {key: value for key, value in values.items() if not key.removeprefix("budget.").startswith(STUDY)}


def scored_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that scores depend on, whatever the method; objects are identified by their contents."""
    parameters = {name: _without_choices(node) for name, node in config["parameter"].items()}
    groups = (group for group in SCORED if group in config)  # older runs lack some
    return {**{group: _without_choices(config[group]) for group in groups}, "parameter": parameters}


def _without_choices(node: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in node.items() if key not in METHOD_KEYS}


def scored_values(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything in the digest ``scoring``, flattened, with the names that comparisons show."""
    config = {**scored_config(results["config"]), "objects": results["config"]["objects"]}
    files = {f"contents of {key}": _short(value) for key, value in flatten(results["files"]).items()}
    return {**flatten(config), **files, "code that trains and scores": results["code"]["scoring"][:8]}


def all_values(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return everything in the digests ``configuration`` and ``scoring``, flattened."""
    config = {key: value for key, value in results["config"].items() if key not in RUN_KEYS}
    method = {"code of the method": results["code"]["method"][:8]}
    return {**flatten(config), **scored_values(results), **method}


def differing(all_of: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names whose values differ between mappings; a group's class, ``_target_``, comes first."""
    names = list(dict.fromkeys(name for values in all_of for name in values))
    different = [n for n in names if any(v.get(n, _ABSENT) != all_of[0].get(n, _ABSENT) for v in all_of)]
    return sorted(different, key=lambda name: not name.endswith("_target_"))


def differences(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Write the first few differences with both values: ``views.count is 8, not 100; ... and 4 more``."""
    names = differing([here, there])
    parts = [f"{n} is {_shown(here, n)}, not {_shown(there, n)}" for n in names[:SHOWN]]
    return "; ".join(parts) + _more(names)


def headings(all_of: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write how each mapping differs from the others: ``views.count=8, ... and 4 more``; empty for a single one."""
    names = differing(all_of)
    return [", ".join(f"{n}={_shown(v, n)}" for n in names[:SHOWN]) + _more(names) for v in all_of]


def _more(names: Sequence[str]) -> str:
    return f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""


_ABSENT = object()


def _shown(values: Mapping[str, Any], name: str) -> str:
    value = values.get(name, _ABSENT)
    return "absent" if value is _ABSENT else str(value)[:80]


def _short(value: Any) -> str:
    return str(value)[:8]

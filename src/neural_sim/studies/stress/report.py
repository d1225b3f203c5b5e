"""What the stress suite leaves: stress.json with every check, stress.md, a table on the screen, a run in MLflow."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neural_sim.report import tracking
from neural_sim.studies.stress.cases import Check


def by_case(results: Sequence[Check]) -> dict[str, list[Check]]:
    """Results of each case, in the order they came."""
    cases: dict[str, list[Check]] = {}
    for result in results:
        cases.setdefault(result.case, []).append(result)
    return cases


def failures(results: Sequence[Check]) -> list[Check]:
    """The checks that failed."""
    return [result for result in results if not result.passed]


def table(results: Sequence[Check]) -> str:
    """One line a case: its checks, the largest part of a tolerance that was used up, its seconds; then what failed."""
    head = f"{'case':<38}{'checks':>7}{'failed':>7}{'used':>9}{'seconds':>9}"
    lines = [head]
    for name, checks in by_case(results).items():
        used = max(result.used for result in checks)
        spent = sum(result.seconds for result in checks)
        lines.append(f"{name:<38}{len(checks):>7}{len(failures(checks)):>7}{used:>9.1g}{spent:>9.2f}")
    wrong = failures(results)
    lines += [
        f"FAILED {r.case}: {r.quantity}: {r.value:.3g}, tolerance {r.tolerance:.3g} {r.status}" for r in wrong
    ]
    spent = sum(result.seconds for result in results)
    lines.append(
        f"{len(results)} checks in {len(by_case(results))} cases, {len(wrong)} failed, {spent:.1f} s"
    )
    return "\n".join(lines)


def markdown(results: Sequence[Check]) -> str:
    """Every check as a table, case by case."""
    parts = ["# Stress suite", f"{len(results)} checks, {len(failures(results))} failed."]
    for name, checks in by_case(results).items():
        rows = [
            f"| {r.quantity.replace('|', chr(92) + '|')} | {r.value:.3g} | {r.tolerance:.3g} | {r.status} | "
            f"{'passed' if r.passed else '**failed**'} | {r.seconds:.3f} |"
            for r in checks
        ]
        header = ["| quantity | value | tolerance | status | | seconds |", "|---|---|---|---|---|---|"]
        parts += [f"## {name}", "\n".join([*header, *rows])]
    return "\n\n".join(parts) + "\n"


def write(results: Sequence[Check], folder: Path) -> Path:
    """stress.json (numbers that do not exist are null) and stress.md in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stress.md").write_text(markdown(results), encoding="utf-8")
    path = folder / "stress.json"
    path.write_text(json.dumps([result.record() for result in results], indent=1, allow_nan=False))
    return path


def track(
    results: Sequence[Check], config: Mapping[str, Any], uri: str, folder: Path, begun: float | None = None
) -> tracking.Run:
    """The suite as a run in MLflow that began at ``begun`` (seconds since 1970), with ``folder`` as its artifacts."""
    metrics = {"checks": float(len(results)), "failed": float(len(failures(results)))}
    for name, checks in by_case(results).items():
        metrics |= {
            f"{name}/failed": float(len(failures(checks))),
            f"{name}/used": max(result.used for result in checks),
            f"{name}/seconds": sum(result.seconds for result in checks),
        }
    name = f"seed {config['seed']}"
    parameters = tracking.flatten({"stress": config["stress"], "seed": config["seed"]})
    tags = {"seed": str(config["seed"])}
    return tracking.log_run(uri, config["name"], name, tags, parameters, metrics, {}, folder, begun)


def report(results: Sequence[Check], config: Mapping[str, Any], folder: Path, begun: float) -> int:
    """Write, log and print; returns the number of checks that failed. ``begun``: when, in seconds since 1970."""
    path = write(results, folder)
    uri = tracking.tracking_uri(config["paths"]["mlflow"])
    run = track(results, config, uri, folder, begun)
    print(table(results))
    print(f"results: {path}\n{run.where}")
    return len(failures(results))

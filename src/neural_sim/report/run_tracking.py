"""A run in MLflow: its final numbers as metrics, its iterations as series, its folder as artifacts."""

from __future__ import annotations

import itertools
from pathlib import Path

from neural_sim.report import tracking
from neural_sim.report.run import RunResults

_CERTIFIED = (
    "stationarity", "solver_steps", "solver_residual", "damping", "curvature_min", "curvature_max", "condition",
    "sensitivity", "cosine",
)  # fmt: skip


def track(results: RunResults, uri: str, folder: Path) -> str:
    """The run in MLflow, with ``folder`` as its artifacts; returns the run's id."""
    metrics = {f"seconds/{stage}": spent for stage, spent in results.seconds.items()}
    metrics |= results.memory
    if results.validation_ap is not None:
        metrics["validation_ap"] = results.validation_ap
    for which, scores in results.ap.items():
        metrics |= {f"evaluate/{which}/ap": scores["ap"], f"evaluate/{which}/ap50": scores["ap50"]}
        metrics |= {f"evaluate/{which}/ap_{name}": value for name, value in scores["per_class"].items()}
    for name, factors in results.total_variations().items():
        for factor, distances in factors.items():
            metrics |= {f"psi/{name}/{factor}/distance_{which}": value for which, value in distances.items()}
    return tracking.log_run(
        uri,
        results.experiment,
        _name(results),
        {
            "method": results.method,
            "seed": str(results.seed),
            "parameter": ",".join(results.config["parameter"]),
            "biased": ",".join(results.biased),
            "gap": results.config.get("gap", "disjoint"),
        },
        tracking.flatten(results.config),
        metrics,
        _series(results) | _curve(results),
        folder,
    )


def _name(results: RunResults) -> str:
    gap = results.config.get("gap", "disjoint")
    return f"{results.method} seed {results.seed}" + ("" if gap == "disjoint" else f" gap {gap}")


def _series(results: RunResults) -> dict[str, list[float]]:
    series: dict[str, list[float]] = {}
    for record in results.records:
        for i, name in enumerate(results.names):
            for factor, probabilities in record["probabilities"].items():
                for b, p in enumerate(probabilities[i]):
                    series.setdefault(f"psi/{name}/{factor}/bin_{b + 1}", []).append(p)
                series.setdefault(f"psi/{name}/{factor}/entropy", []).append(record["entropies"][factor][i])
            if record["certificate"]:
                series.setdefault(f"psi/{name}/gradient_norm", []).append(record["gradient_norms"][i])
                for factor, p_value in record["certificate"]["p_values"].get(name, {}).items():
                    series.setdefault(f"psi/{name}/{factor}/p_value", []).append(p_value)
                for factor, action in record["certificate"]["actions"].get(name, {}).items():
                    series.setdefault(f"psi/{name}/{factor}/trusted", []).append(float(action == "kept"))
        for key in ("validation_loss", "training_loss", "images", "detector_steps", "products"):
            series.setdefault(f"psi/{key}", []).append(record[key])
        for key in _CERTIFIED if record["certificate"] else ():
            series.setdefault(f"psi/{key}", []).append(record["certificate"][key])
        for phase, spent in record["seconds"].items():
            series.setdefault(f"psi/seconds_{phase}", []).append(spent)
    for name, history in results.fields.items():
        for key in ("psnr", "ssim"):
            series[f"field/{name}/{key}"] = [row[key] for row in history if key in row]
    return series


def _curve(results: RunResults) -> dict[str, dict[int, float]]:
    """AP of all objects and of the biased ones by what was spent; the step is that, so that runs chart side by side."""
    found: dict[str, dict[int, float]] = {}
    for point in results.curve:
        scores = {"ap": point["ap"]["ap"]}
        if results.biased:
            per_class = point["ap"]["per_class"]
            scores["biased_ap"] = sum(per_class[name] for name in results.biased) / len(results.biased)
        for by, (what, value) in itertools.product(("iteration", "images", "seconds"), scores.items()):
            found.setdefault(f"curve/{what}_by_{by}", {})[round(point[by])] = value
    return found

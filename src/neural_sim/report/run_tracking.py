"""Log a run to MLflow: its iterations as series, as they end; its final numbers; its folder as artifacts."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from neural_sim.detector.metrics import mean_of, mean_over
from neural_sim.report import tracking
from neural_sim.report.model_files import log_detector
from neural_sim.report.run import RunResults

_NAMES = (
    "`evaluate/ns` scores the detector trained on the initial distribution, `evaluate/learned` the one trained on the "
    "learned distribution, and `evaluate/matched` the one trained on the target's. The page `report.html` is among "
    "the artifacts."
)
_COUNTED = ("validation_loss", "training_loss", "images", "detector_steps", "products", "cpu_seconds")


class LiveRun:
    """A run in MLflow while its stages are running. Iterations and fields are written only once, even if repeated."""

    def __init__(self, run: tracking.Run, names: Sequence[str]) -> None:
        self._run, self._names = run, names
        self._iterations, self._fields = 0, set[str]()

    @property
    def where(self) -> str:
        """How to open the run in MLflow, see ``tracking.where``."""
        return self._run.where

    def iteration(self, record: Mapping[str, Any]) -> None:
        """Write an iteration of the psi loop that has just ended."""
        self._run.log(_of_iteration(record, self._names), self._iterations)
        self._iterations += 1

    def iterations(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Write the iterations that were not written when they ended, because the loop's result was in the store."""
        for record in records[self._iterations :]:
            self.iteration(record)

    def fields(self, histories: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
        """Write the scores of fields while they were fitted, by object."""
        for name in histories.keys() - self._fields:
            rows = histories[name]
            scores = {key: [row[key] for row in rows if key in row] for key in ("psnr", "ssim")}
            self._run.log_series({f"field/{name}/{key}": values for key, values in scores.items()})
            self._fields.add(name)

    def stage(self, name: str, seconds: float) -> None:
        """Write the duration of a stage that has just ended."""
        self._run.log({f"seconds/{name}": seconds})

    def detector(
        self, folder: Path, example: UInt8[np.ndarray, "n h w 3"], registered_name: str | None = None
    ) -> str:
        """Write the run's detector as a model, see ``model_files.log_detector``."""
        return log_detector(self._run, folder, example, registered_name)

    def finish(self, results: RunResults, folder: Path, headline: str) -> None:
        """Write the rest: iterations and fields from the store, final numbers, and ``folder`` as artifacts.

        The run's description is ``headline`` and what the names of the scored detectors mean.
        """
        self._run.tag("mlflow.note.content", f"{headline}\n\n{_NAMES}")
        self.iterations(results.records)
        self.fields(results.fields)
        self._run.log(_final(results))
        self._run.log_series(_curve(results))
        self._run.log_files(folder)


@contextmanager
def live_run(
    uri: str,
    config: Mapping[str, Any],
    method: str,
    names: Sequence[str],
    biased: Sequence[str],
    begun: float | None = None,
    scale: str = "",
) -> Iterator[LiveRun]:
    """Open a run with the configuration as its parameters, see ``tracking.opened``.

    Its name and tags tell it from others of its experiment: method, seed, scale, detector and objects.
    """
    seed, gap = config["seed"], config.get("gap", "disjoint")
    name = f"{method} seed {seed}" + ("" if gap == "disjoint" else f" gap {gap}")
    name += f" {scale}" if scale not in ("", "quick") else ""
    detector = config.get("detector", {})
    kind = str(detector.get("_target_", "")).rpartition(".")[2]
    tags = {
        "method": method,
        "seed": str(seed),
        "parameter": ",".join(config["parameter"]),
        "biased": ",".join(biased),
        "gap": gap,
        "scale": scale,
        "detector": f"{kind} {detector.get('backbone', {}).get('architecture', '')}".strip(),
        "objects": ",".join(names),
    }
    with tracking.opened(uri, config["name"], name, tags, tracking.flatten(config), begun) as run:
        yield LiveRun(run, names)


def _key(results: RunResults) -> str:
    """Return the score's name in metrics."""
    return results.score.lower()


def _final(results: RunResults) -> dict[str, float]:
    metrics = dict(results.memory)
    if results.validation_ap is not None:
        metrics[f"validation_{_key(results)}"] = results.validation_ap
    for which, scores in results.ap.items():
        metrics |= {
            f"evaluate/{which}/{key}": scores[key] for key in ("ap", "ap50", "accuracy") if key in scores
        }
        metrics |= {
            f"evaluate/{which}/{_key(results)}_{name}": value for name, value in scores["per_class"].items()
        }
    for one in results.learned:
        own = f"psi/{one.name}/{one.factor}"
        metrics |= {f"{own}/distance_{which}": value for which, value in one.distances.items()}
    return metrics


def _of_iteration(record: Mapping[str, Any], names: Sequence[str]) -> dict[str, float]:
    metrics: dict[str, float] = {}
    certificate = record["certificate"]
    for i, name in enumerate(names):
        for factor, probabilities in record["probabilities"].items():
            own = f"psi/{name}/{factor}"
            metrics |= {f"{own}/bin_{b}": p for b, p in enumerate(probabilities[i], 1)}
            metrics[f"{own}/entropy"] = record["entropies"][factor][i]
        if certificate:
            p_values, actions = (certificate[key].get(name, {}) for key in ("p_values", "actions"))
            metrics |= {f"psi/{name}/{factor}/p_value": value for factor, value in p_values.items()}
            metrics |= {
                f"psi/{name}/{factor}/trusted": float(a in ("kept", "waited"))
                for factor, a in actions.items()
            }
            metrics[f"psi/{name}/gradient_norm"] = record["gradient_norms"][i]
        if record["scores"]:
            metrics[f"psi/{name}/score"] = record["scores"][i]
        if name in record["verdicts"]:
            metrics[f"psi/{name}/accepted"] = float(record["verdicts"][name]["accepted"])
        if name in record["taken_back"]:
            metrics[f"psi/{name}/steps_kept"] = float(record["taken_back"][name]["kept"])
    metrics |= {f"psi/{key}": record[key] for key in _COUNTED}
    if certificate:
        numbers = {**(certificate["adjoint"] or {}), "cosine": certificate["cosine"]}
        metrics |= {f"psi/{key}": value for key, value in numbers.items() if isinstance(value, (int, float))}
    return metrics | {f"psi/seconds_{phase}": spent for phase, spent in record["seconds"].items()}


def _curve(results: RunResults) -> dict[str, dict[int, float]]:
    """Return the scores of all objects and of the biased ones, as functions of the cost.

    The cost serves as MLflow's step, so that charts compare runs at equal cost.
    """
    series: dict[str, dict[int, float]] = {}
    for point in results.curve:
        scores = {_key(results): mean_of(point["ap"])}
        if results.biased:
            scores[f"biased_{_key(results)}"] = mean_over(point["ap"], results.biased)
        for by, (what, value) in itertools.product(("iteration", "images", "seconds"), scores.items()):
            series.setdefault(f"curve/{what}_by_{by}", {})[round(point[by])] = value
    return series

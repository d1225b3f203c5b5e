"""The stages of a run in their order, each skipped when its result is in the store."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from neural_sim import versions
from neural_sim.artifacts import Artifacts
from neural_sim.devices import peak_memory_mb
from neural_sim.experiment import Experiment
from neural_sim.outer.records import Cost, IterationRecord
from neural_sim.plan import plan
from neural_sim.report.identity import identity
from neural_sim.report.run import (
    RunResults,
    write_detections,
    write_figures,
    write_results,
    write_training_set,
)
from neural_sim.report.run_tracking import LiveRun, live_run
from neural_sim.report.tracking import tracking_uri
from neural_sim.store import code_version
from neural_sim.synthesis.scene import join

_log = logging.getLogger(__name__)

STAGES = ("views", "field", "warm_start", "psi", "evaluate", "report")


class Pipeline:
    """Walks the stages and reports, to MLflow while they go on where a :class:`LiveRun` listens."""

    def __init__(self, experiment: Experiment) -> None:
        self.x = experiment
        self.live: LiveRun | None = None
        self.made = Artifacts(experiment, self._iteration)

    def _iteration(self, record: IterationRecord) -> None:
        if self.live:
            self.live.iteration(dataclasses.asdict(record))

    @contextmanager
    def tracked(self) -> Iterator[None]:
        """An MLflow run for what is inside, if the report is asked for."""
        x = self.x
        if "report" not in x.stages:
            yield
            return
        names, biased, uri = self.made.names, x.distribution.biased, tracking_uri(x.mlflow)
        with live_run(uri, x.name, x.baseline.name, x.seed, names, biased, x.config) as self.live:
            _log.info("to watch this run:\n%s", self.live.where)
            yield

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count a stage's seconds if it is asked for."""
        begin = time.perf_counter()
        yield
        spent = self.made.account.seconds[name] = time.perf_counter() - begin
        _log.info("%-10s %8.1f s", name, spent)
        if self.live:
            self.live.stage(name, spent)

    def run_stage(self, name: str) -> None:
        """Make or find a stage's results."""
        if name in ("views", "field"):
            for item in tqdm(self.made.names, desc=name, disable=not self.x.progress, leave=False):
                found = getattr(self.made, name)(item)
                if name == "field" and self.live:
                    self.live.fields({item: found["history"]})
        elif name == "warm_start":
            self.made.warm_start()
        elif name == "psi":
            records = self.made.learned()["records"]
            if self.live:
                self.live.iterations(records)
        elif name == "evaluate":
            scored = {**self.made.compared(), **self.made.on_the_way()}
            for what, psi in tqdm(scored.items(), desc=name, disable=not self.x.progress, leave=False):
                self.made.scores(psi, what)
            self.made.validation_ap()

    def results(self) -> RunResults:
        """What there is to report: a run without evaluation has no AP."""
        psi = {
            "initial": self.made.psi("initial"),
            "learned": self.made.learned_psi,
            "target": self.made.psi("target"),
        }
        evaluated = "evaluate" in self.x.stages
        scores = (
            {what: self.made.scores(psi, what)["ap"] for what, psi in self.made.compared().items()}
            if evaluated
            else {}
        )
        return RunResults(
            experiment=self.x.name,
            method=self.x.baseline.name,
            seed=self.x.seed,
            names=self.made.names,
            biased=self.x.distribution.biased,
            probabilities={which: self.x.distribution.probabilities(value) for which, value in psi.items()},
            records=self.made.learned()["records"],
            ap=scores,
            validation_ap=self.made.validation_ap() if evaluated else None,
            fields={name: self.made.field(name)["history"] for name in self.made.names},
            seconds=dict(self.made.account.seconds),
            memory=peak_memory_mb(self.made.device),
            left_out=[dataclasses.asdict(omission) for omission in self.made.account.left_out],
            config=self.x.config,
            curve=self.curve() if evaluated else (),
            symmetric_bins=self.made.symmetric_bins,
            identity=self.identity(),
        )

    def identity(self) -> dict[str, Any]:
        """What says which runs this one can be compared with."""
        files = {"objects": self.made.digests, **self.made.files}
        code = {"scoring": code_version(*versions.SCORING), "method": code_version(*versions.LOOPS)}
        return identity(self.x.config, files, code, self.made.targets["test"])

    def curve(self) -> list[dict[str, Any]]:
        """What the method had spent, its warm start included, and what its psi was worth, at its start (which costs
        nothing), on the way as asked, and at its end."""
        learned, points = self.made.learned(), []
        for iteration, psi in self.made.scored_iterations().items():
            spent = (
                Cost(**learned["before"]) + Cost.of(learned["records"][:iteration]) if iteration else Cost()
            )
            ap = self.made.scores(psi, f"psi after {iteration} iterations")["ap"]
            points.append({"iteration": iteration, **dataclasses.asdict(spent), "ap": ap})
        return points

    def report(self, folder: Path) -> None:
        """Figures, the final training set, results.json, MLflow."""
        if self.live is None:
            raise RuntimeError("report: want an open MLflow run, see Pipeline.tracked")
        results = self.results()
        drawn = self.made.training_images(self.made.learned_psi)
        test = self.made.targets["test"]
        detections = self.made.scores(self.made.learned_psi, "learned")["detections"] if results.ap else []
        write_figures(results, join(drawn), test, detections, folder / "figures")
        write_training_set(drawn, self.made.names, folder / "training_set")
        if results.ap:
            scored = {which: self.made.scores(psi, which) for which, psi in self.made.compared().items()}
            write_detections(test, {which: held["detections"] for which, held in scored.items()}, folder)
        write_results(results, folder)
        self.live.finish(results, folder)
        print(results.summary())
        print(f"results: {folder}\n{self.live.where}")


def run(experiment: Experiment, folder: Path) -> float | None:
    """Run the stages asked for, in order; the report lands in ``folder``.

    Returns what a sweep may maximise, :meth:`Artifacts.validation_ap`: the test set has no part in it. None without
    the evaluate stage.
    """
    pipeline = Pipeline(experiment)
    pipeline.made.account.left_out += plan(experiment, len(pipeline.made.names))
    for omission in pipeline.made.account.left_out:
        share = "" if omission.share in (None, 1.0) else f" ({omission.share:.0%})"
        _log.info("left out: %s%s: %s", omission.what, share, omission.why)
    with pipeline.tracked():
        for name in STAGES[:-1]:
            if name in experiment.stages:
                with pipeline.stage(name):
                    pipeline.run_stage(name)
        if "report" in experiment.stages:
            with pipeline.stage("report"):
                pipeline.report(folder)
    return pipeline.made.validation_ap() if "evaluate" in experiment.stages else None

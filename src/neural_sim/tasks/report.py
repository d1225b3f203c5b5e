"""Task ``report``: write the page, figures, final training set, table of psi and results.json; log them to MLflow."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from typing_extensions import override

from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.devices import peak_memory_mb, placed
from neural_sim.documents import write_whole
from neural_sim.report.detections import write_detections, write_training_set
from neural_sim.report.figures import write_figures
from neural_sim.report.identity import identity
from neural_sim.report.page.run_page import PER_OBJECT, RunPage, Shown
from neural_sim.report.provenance import Made, machine
from neural_sim.report.run import RunResults, write_results
from neural_sim.stages.evaluate import Scores
from neural_sim.stages.graph import Psi
from neural_sim.stages.stage import Stage
from neural_sim.synthesis.export.psi_table import psi_csv, psi_rows
from neural_sim.tasks.context import Context, Task
from neural_sim.types import LabelledImages

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReportTask(Task):
    """The final results of a run, in its folder and in MLflow."""

    @override
    def reads(self, context: Context) -> Iterable[Stage[Any]]:
        graph = context.graph
        return [*graph.fields, graph.targets, graph.learned, graph.scores(graph.psi("initial"), "ns")]

    @override
    def run(self, context: Context) -> None:
        if context.live is None:
            raise RuntimeError("report: want an open MLflow run, see Context.tracked")
        graph, results, folder = context.graph, context.results, context.folder
        learned, test = results(graph.learned), results(graph.targets).test
        for stage in context.shown(graph.evaluated(learned), "evaluate"):
            results(stage)
        scores = {called: results(stage) for called, stage in graph.compared(learned).items()}
        report = run_results(context, scores)
        write_results(report, folder)  # first, so that the numbers are there whatever fails later
        rendered = graph.synthetic(learned.last, "learned").images(results)
        drawn = dataclasses.replace(rendered, images=rendered.images.to("cpu"))
        shown = _shown(context, learned.last, test, scores)
        found, pair = scores["learned"].detections, (shown.before, shown.after)
        write_figures(report, drawn.images, test, found, folder / "figures", pair, shown.bins)
        write_training_set(drawn, list(graph.names), folder / "training_set")
        write_detections(test, {called: part.detections for called, part in scores.items()}, folder)
        write_whole(folder / "psi.csv", _psi_table(context, learned.last))
        _write_model(context, test)
        commands = _commands(context)
        page = RunPage(report, shown)
        path = page.write(commands, folder)
        print(report.summary())
        context.live.finish(report, folder, page.headline)
        print(f"results: {folder}\n{context.live.where}")
        for what, command in commands.items():
            print(f"{what.lower()}: {command}")
        context.last_words = f"{page.headline}\ndid it work? open {path}"


def _shown(context: Context, psi: Psi, test: LabelledImages, scores: Mapping[str, Scores]) -> Shown:
    """Return the pictures of the page: images before and after, drawn with the same random numbers, and detections."""
    graph, scene = context.graph, context.results(context.graph.scene)
    before, after = (
        scene.training_set(each, max(PER_OBJECT.values()), graph.warm_start.generator()).images.to("cpu")
        for each in (graph.psi("initial"), psi)
    )
    bins = {stage.object: context.results(stage).bins for stage in graph.qualities}
    return Shown(before, after, test, {called: part.detections for called, part in scores.items()}, bins)


def _psi_table(context: Context, psi: Psi) -> str:
    """Return the learned distribution as CSV, in the format of an export."""
    distribution = context.experiment.imaging.distribution
    return psi_csv(psi_rows(distribution, psi, context.graph.names))


def _commands(context: Context) -> dict[str, str]:
    """Return commands to run next, by what they do."""
    name, folder = context.config["name"], context.folder
    return {
        "To compare methods and seeds": f"python -m src.main +experiment=compare 'compare.experiments=[{name}]'",
        "To detect objects in photographs": f"python -m src.main 'stages=[predict]' predict.model={folder} "
        "predict.images=/data/photos",
    }


def _write_model(context: Context, test: LabelledImages) -> None:
    """Write the detector that was scored as ``learned`` to the folder, and to MLflow if asked for.

    A detector whose settings cannot be written as JSON is left out with a warning.
    """
    graph, results, wanted = context.graph, context.results, context.experiment.model
    stage = graph.trained_on(results(graph.learned).last, "learned")
    camera = graph.camera
    params = placed(results(stage).params, torch.device("cpu"))
    saved = SavedDetector(stage.detector, params, graph.names, (camera.height, camera.width), camera)
    try:
        wanted.write(saved, test.images, context.folder)
    except ValueError as error:
        _log.warning("report: the detector's files are left out: %s", error)
        return
    if wanted.pyfunc and context.live is not None:
        example = test.images[:1].mul(255).round().byte().movedim(1, -1).cpu().numpy()
        uri = context.live.detector(context.folder, example, wanted.registered_name)
        print(f"model: {uri}")


def run_results(context: Context, scores: Mapping[str, Scores], symmetric: bool = True) -> RunResults:
    """Gather the results to report; without ``symmetric``, bins that look the same are not listed."""
    x, graph, results = context.experiment, context.graph, context.results
    distribution, learned = x.imaging.distribution, results(graph.learned)
    psi = {"initial": graph.psi("initial"), "learned": learned.last, "target": graph.target_psi}
    angles = [factor.name for factor in distribution.binned if factor.coordinate in ("phi", "rho")]
    fields = {stage.views.object: results(stage).history for stage in graph.fields}
    return RunResults(
        experiment=x.run.name,
        method=x.loop.method.name,
        seed=x.run.seed,
        names=list(graph.names),
        biased=distribution.biased,
        probabilities={
            which: distribution.probabilities(value) for which, value in psi.items() if value is not None
        },
        records=[dataclasses.asdict(record) for record in learned.records],
        ap={called: dataclasses.asdict(part.ap) for called, part in scores.items()},
        validation_ap=results(graph.validation(learned)).ap.mean,
        fields=fields,
        seconds={phase: spent for phase, spent in context.account.seconds.items() if phase != "report"},
        memory=peak_memory_mb(graph.device),
        left_out=[dataclasses.asdict(omission) for omission in context.account.left_out],
        config=x.config,
        curve=_curve(context),
        symmetric_bins={
            name: {angle: results(graph.symmetry(name, angle)) for angle in angles}
            for name in graph.names
            if symmetric
        },
        identity=_identity(context),
        real=_real(context),
        score=x.score,
        shown=learned.shown,
        made=Made(
            context.command,
            context.scale,
            time.strftime("%Y-%m-%d %H:%M"),
            machine(graph.device),
            "synthetic test images" if graph.renders_target else "test photographs",
        ),
    )


def _real(context: Context) -> dict[str, Any]:
    """Return how photographs were used in training; empty if they were not."""
    real = context.experiment.training.real
    if not real.used:
        return {}
    train = context.results(context.graph.targets).train
    available = 0 if train is None else len(train)
    return {"mode": real.mode, "photographs": real.number(available), "available": available}


def _curve(context: Context) -> list[dict[str, Any]]:
    """Return cost and score of psi at the start, at the iterations asked for, and at the end."""
    graph, results = context.graph, context.results
    learned, points = results(graph.learned), []
    for iteration, psi in graph.on_the_way(learned).items():
        ap = results(graph.scores(psi, f"psi after {iteration} iterations")).ap
        spent = dataclasses.asdict(learned.cost(iteration))
        points.append({"iteration": iteration, **spent, "ap": dataclasses.asdict(ap)})
    return points


def _identity(context: Context) -> dict[str, Any]:
    """Return the identity that decides which runs this one can be compared with."""
    graph, imaging = context.graph, context.experiment.imaging
    sources: dict[str, Any] = {"background": imaging.synthesis.background}
    if imaging.synthesis.distractors.used:
        sources["distractors"] = imaging.synthesis.distractors
    read = {name: source.digest() for name, source in sources.items() if hasattr(source, "digest")}
    if (target := imaging.target.digest()) is not None:
        read["target"] = target
    scored, learned = graph.scores(graph.psi("initial"), "initial"), graph.learned
    code = {"scoring": scored.description["code"], "method": learned.description["code"]}
    test = context.results(graph.targets).test
    return identity(context.experiment.config, {"objects": graph.objects.digests, **read}, code, test)

"""AP of several sources: means, paired intervals, the table and what is written."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mlflow import MlflowClient

from neural_sim.report.score_table import ScoreTable, match
from neural_sim.studies.sources import Samples, SideBySide, ap_figure, publish, table
from neural_sim.types import LabelledImages

BOX = torch.tensor([[10.0, 10.0, 30.0, 30.0]])


def truth(count):
    """One box of class 0 in even images, of class 1 in odd ones."""
    labels = (torch.arange(count) % 2)[:, None]
    return LabelledImages(
        torch.rand(count, 3, 40, 40), BOX.expand(count, 1, 4), labels, torch.zeros(count).long()
    )


def detections(images, right):
    """The true box where ``right`` says so, else a box far from it."""
    return [
        {"boxes": BOX if hit else BOX - 10.0, "labels": label, "scores": torch.tensor([0.9])}
        for hit, label in zip(right, images.labels, strict=True)
    ]


def found(draws=200):
    """Three sources, of which the first finds all, the second as well, the third the boxes of class 0 alone."""
    images = truth(24)
    hits = ([True] * 24, [True] * 24, [i % 2 == 0 for i in range(24)])
    rows = [[match(detections(images, hit), images, label) for label in (0, 1)] for hit in hits]
    outcomes = {source: [row, row] for source, row in zip(("nerf", "mesh", "other"), rows, strict=True)}
    return SideBySide.of({"single": ScoreTable.of(outcomes, ["can", "mug"], draws)}, [0, 1], {"single": 48})


def test_ap_and_paired_differences():
    result = found()
    ap = {source: estimate.value for source, estimate in result.ap["single"].items()}
    assert ap == pytest.approx({"nerf": 1.0, "mesh": 1.0, "other": 0.5})
    same, behind = result.ahead["single"]["mesh"], result.ahead["single"]["other"]
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0) and not same.certain
    assert behind.value == pytest.approx(0.5) and behind.certain
    assert result.per_class["single"]["other"] == pytest.approx({"can": 1.0, "mug": 0.0})


def test_the_interval_covers_the_spread_over_images():
    """A source that finds each box with probability 1/2: precision 1 at the recalls that it reaches, so that AP is the
    fraction found; its standard deviation over 400 images is 0.025."""
    images = truth(400)
    hit = np.random.default_rng(0).random(400) < 0.5
    kept = [
        d if h else {k: v[:0] for k, v in d.items()}
        for d, h in zip(detections(images, hit), hit, strict=True)
    ]
    row = [match(kept, images, label) for label in (0, 1)]
    table_of_one = ScoreTable.of({"nerf": [row], "mesh": [row]}, ["can", "mug"], 300)
    estimate = SideBySide.of({"single": table_of_one}, [0], {"single": 400}).ap["single"]["nerf"]
    # 101 recalls: AP is the fraction to within 1/101.
    assert estimate.value == pytest.approx(hit.mean(), abs=0.011)
    assert estimate.high - estimate.low == pytest.approx(2 * 1.96 * 0.025, rel=0.25)


def test_the_table_and_the_files_have_every_source(context):
    result = found(20)
    shown = Samples({"nerf": 4, "mesh": 4, "other": 9}, LabelledImages.concatenate([truth(4)] * 3))
    text = table(result, "A heading.")
    assert "| single | 48 | 100.0 (100.0 to 100.0) |" in text and "nerf ahead of other by" in text
    assert "| single, mug | 100.0 | 100.0 | 0.0 |" in text
    assert "| **50.0** (" in text and "Differences are in bold if their interval excludes 0." in text
    one = table(replace(result, seeds=(0,)), "A heading.")
    assert "**" not in one and "bold" not in one and "intervals over test images; seed 0." in one
    run = publish(context, result, shown, "A heading.")
    document = json.loads((context.folder / "study.json").read_text())
    assert document["training_images"]["other"] == 9
    assert "first seed: 4 of nerf, 4 of mesh, 9 of other." in (context.folder / "study.md").read_text()
    assert document["ap"]["single"]["other"]["value"] == pytest.approx(0.5)
    assert {path.name for path in (context.folder / "figures").iterdir()} == {
        "ap.png",
        "training_images.png",
    }
    assert MlflowClient(context.uri).get_run(run.run_id).data.metrics["single/mesh/ap"] == pytest.approx(1.0)


def test_a_source_of_fewer_images_has_a_row_of_its_own():
    """A folder of another program may hold fewer images than are shown; every row has as many as the smallest."""

    def source(count, value):
        images = replace(truth(count), images=torch.full((count, 3, 8, 8), value))
        return SimpleNamespace(images=lambda results: SimpleNamespace(images=images))

    samples = Samples.of(None, {"nerf": source(20, 0.2), "blenderproc": source(3, 0.7)}, 8)
    assert samples.counts == {"nerf": 20, "blenderproc": 3}
    assert samples.shown.images[:, 0, 0, 0].tolist() == pytest.approx([0.2] * 3 + [0.7] * 3)


def test_a_class_that_one_seed_does_not_show_has_the_mean_of_the_others():
    images = truth(8)
    both = [match(detections(images, [True] * 8), images, label) for label in (0, 1)]
    cans = images.select(torch.arange(0, 8, 2))
    one = [match(detections(cans, [False] * 4), cans, label) for label in (0, 1)]
    scores = ScoreTable.of({"nerf": [both, one]}, ["can", "mug"], 2)
    assert scores.by_class("nerf") == pytest.approx({"can": 0.5, "mug": 1.0})


def test_a_long_heading_stays_in_the_figure():
    figure = ap_figure(
        found(2), "Detectors trained on images of fields and of meshes reconstructed from views (sfm)."
    )
    figure.draw_without_rendering()
    title = figure._suptitle.get_window_extent()
    assert title.x0 >= 0.0 and title.x1 <= figure.bbox.x1

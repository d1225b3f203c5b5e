"""Which settings a stored detector depends on: what its images are drawn from, not how a method relaxes the draws."""

import json
from dataclasses import replace
from typing import Any, cast
from unittest.mock import Mock

import pytest
import torch
from composing import composed
from PIL import Image

from neural_sim.baseline.label_shift.estimate import Estimate
from neural_sim.main import build
from neural_sim.outer.first_step import WhatTheTargetShows
from neural_sim.outer.inner import RenderedPool
from neural_sim.outer.records import Cost, LearnedPsi
from neural_sim.stages import shown
from neural_sim.stages.graph import Graph
from neural_sim.stages.stage import Results
from neural_sim.stages.store import Store


def keys(tmp_path, *overrides):
    config = composed("+experiment=pose_gap", "scale=smoke", *overrides, f"paths.store={tmp_path}")
    graph = Graph(build(config))
    return graph.of_initial.key, graph.targets.key


@pytest.mark.parametrize("other", ["floor=0.0", "temperature=1.0", "bin_mean=linear"])
def test_methods_that_relax_differently_share_the_detectors_of_a_distribution(tmp_path, other):
    assert keys(tmp_path)[0] == keys(tmp_path, f"parameter.pose.{other}")[0]


@pytest.mark.parametrize(
    "other",
    ["seed=1", "parameter.pose.bins=9", "parameter.pose.other_range_deg=[-30,30]", "unlearned.distance=[2.5,4.0]",
     "training.warm_epochs=4", "detector=micro", "parameter.pose.initial={dominant: 1}", "gap=uniform"],
)  # fmt: skip
def test_what_images_are_drawn_from_tells_detectors_apart(tmp_path, other):
    assert keys(tmp_path)[0] != keys(tmp_path, other)[0]


def test_detectors_do_not_depend_on_the_target_but_its_images_do(tmp_path):
    ours, other = keys(tmp_path), keys(tmp_path, "parameter.pose.target={dominant: 1}")
    assert ours[0] == other[0] and ours[1] != other[1]


@pytest.mark.parametrize("overrides", [["training.warm_start=initial"], ["gap=uniform"]])
def test_the_scored_detector_of_the_start_is_the_warm_start_where_images_and_epochs_are_equal(
    tmp_path, overrides
):
    common = ["+experiment=pose_gap", "scale=smoke", f"paths.store={tmp_path}"]
    graph = Graph(build(composed(*(common + overrides))))
    other = Graph(build(composed(*common)))
    assert graph.trained_on(graph.psi("initial"), "the start").key == graph.warm_start.key
    assert graph.trained_on(graph.psi("target"), "the target").key != graph.warm_start.key
    scored = other.trained_on(other.psi("initial"), "the start").key
    assert scored != other.warm_start.key
    assert (scored == graph.warm_start.key) == ("gap=uniform" not in overrides)


def test_a_uniform_warm_start_is_trained_on_images_of_every_bin():
    overrides = ["+experiment=pose_gap", "parameter=[pose,zoom]"]
    graph = Graph(build(composed(*overrides)))
    p = graph.experiment.imaging.distribution.probabilities(graph.warm_start.psi)
    assert all(torch.allclose(values, torch.full_like(values, 1 / values.shape[1])) for values in p.values())
    assert graph.warm_start.psi.shape == graph.psi("initial").shape


def test_what_reads_psi_off_the_target_wants_no_warm_start_and_shares_the_renders_of_the_loop(tmp_path):
    common = ["+experiment=pose_gap", "scale=smoke", f"paths.store={tmp_path}"]
    loop, reading = (
        Graph(build(composed(*common, f"baseline={name}"))) for name in ("neural_sim", "label_shift")
    )
    made = Results(Store(tmp_path)).missing([reading.learned])
    assert {stage.kind for stage in made if stage.phase == "psi"} == {"pool", "shown", "psi"}
    assert reading.read_warm_start == () and not any(stage.kind == "detector" for stage in made)
    assert loop.read_warm_start == (loop.warm_start,)
    assert loop.shown.pool is loop.learned.pool and loop.shown.pool.key == reading.shown.pool.key


def test_an_estimate_is_charged_for_the_renders_that_it_reads(tmp_path, monkeypatch):
    config = ["+experiment=pose_gap", "scale=smoke", "baseline=label_shift", f"paths.store={tmp_path}"]
    stage = replace(Graph(build(composed(*config))).shown, symmetries=())
    pool = RenderedPool(cast(Any, None), torch.Generator().get_state(), Cost(seconds=9.0, cpu_seconds=8.0))
    found = Estimate((), stage.psi, 5, 2.0, {"pool": 0.5, "images": 1.0})
    monkeypatch.setattr(shown, "estimate", lambda *arguments: found)
    made = stage.make(cast(Any, lambda wanted: pool if wanted is stage.pool else Mock()))
    assert made.seconds == 11.0 and made.cpu_seconds == {"pool": 8.5, "images": 1.0}


@pytest.mark.parametrize("renders", [True, False])
def test_photographs_are_read_as_such_by_the_method_and_by_the_loop_s_first_step(
    tmp_path, monkeypatch, renders
):
    graph = Graph(build(composed("+experiment=pose_gap", "scale=smoke", f"paths.store={tmp_path}")))
    targets = replace(graph.targets, target=Mock(renders=renders))
    pool, settings = RenderedPool(cast(Any, None), torch.Generator().get_state(), Cost()), []

    def estimated(scene, images, psi, chosen, *rest):
        settings.append(chosen)
        return Estimate((), psi, 5, 2.0, {"pool": 0.5})

    monkeypatch.setattr(shown, "estimate", estimated)
    stage = replace(graph.shown, symmetries=(), targets=targets)
    stage.make(cast(Any, lambda wanted: pool if wanted is stage.pool else Mock()))
    loop = replace(graph.learned, symmetries=(), targets=targets)
    first = loop._first_step(cast(Any, Mock()), False)
    assert isinstance(first, WhatTheTargetShows)
    for chosen in (settings[0], first.settings):
        assert chosen.photographs is not renders
        assert chosen.augmentation.roll_deg == (10.0 if renders else 180.0)


def test_a_first_hypergradient_at_a_warm_start_of_other_images_is_refused():
    config = ["+experiment=pose_gap", "baseline=auto_sim", "outer.train_first=false"]
    build(composed(*config, "training.warm_start=initial"))
    with pytest.raises(ValueError, match=r"training\.warm_start"):
        build(composed(*config))


def test_objects_that_no_source_has_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"outer\.learned: want some of .*, got \['drill'\]"):
        keys(tmp_path, "objects.names=[pitcher,mug]")


@pytest.mark.parametrize(
    ("target", "overrides", "known"),
    [
        ("rendered", [], True),
        ("coco", [], False),
        ("coco", ["parameter.pose.initial={dominant: 1}"], False),
        ("coco", ["parameter.pose.target={dominant: 1}"], True),
        ("coco", ["parameter.pose.biased={mug: {target: {dominant: 2}}}"], True),
        ("coco", ["parameter.pose.biased={mug: {initial: {dominant: 2}}}"], False),
    ],
)
def test_the_target_s_distribution_is_known_where_it_is_rendered_or_stated(
    tmp_path, target, overrides, known
):
    """Else no detector is called matched, and nothing can be drawn from it."""
    labels = tmp_path / "labels.json"
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    entry = {"id": 1, "file_name": "a.png", "height": 8, "width": 8}
    document = {"images": [entry], "categories": [{"id": 1, "name": "mug"}]}
    box = {"image_id": 1, "category_id": 1, "bbox": [2, 2, 4, 4]}
    labels.write_text(json.dumps({**document, "annotations": [box]}))
    photographs = ["target=coco", f"target.annotations={labels}"] if target == "coco" else []
    words = ["scale=smoke", *photographs, *overrides, f"paths.store={tmp_path}"]
    graph = Graph(build(composed(*words)))
    assert (graph.target_psi is not None) == known
    psi = graph.psi("initial")
    assert ("matched" in graph.compared(LearnedPsi(psi[None], []))) == known
    assert torch.equal(graph.stated_psi("initial", "export.psi"), psi)
    if known:
        assert torch.equal(graph.stated_psi("target", "export.psi"), graph.psi("target"))
        return
    with pytest.raises(ValueError, match=r"^export\.psi=target: the target's distribution is unknown"):
        graph.stated_psi("target", "export.psi")


def test_stages_that_the_loop_cannot_train_are_refused_before_anything_is_made():
    graph = Graph(build(composed("+experiment=pose_gap", "outer.loop_layers=4")))
    with pytest.raises(ValueError, match=r"outer\.loop_layers must be at least 0 and below 4, got 4"):
        _ = graph.learned

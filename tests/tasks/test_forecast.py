"""What a run says of its time before it begins: the last run's, or measured costs by the speed of the machine."""

import json

import pytest
from captures import capture
from composing import composed

from neural_sim.main import context_of
from neural_sim.tasks import forecast as module
from neural_sim.tasks.forecast import LAYERS, MEASURED, forecast


@pytest.fixture(autouse=True)
def as_measured(monkeypatch):
    """The machine of the table, one thread."""
    monkeypatch.setattr(module, "_layers", lambda: LAYERS)


def said(folder, *overrides, scale="quick"):
    words = ["+experiment=pose_gap", f"scale={scale}", f"paths.store={folder / 'store'}", *overrides]
    context, tasks = context_of(composed(*words), folder / "pose_gap" / "now")
    context.scale = scale
    missing = context.results.missing(stage for task in tasks.values() for stage in task.reads(context))
    return forecast(context, [stage for stage in missing if stage.stored])


def test_a_first_run_is_told_by_measured_costs_of_its_phases(tmp_path):
    """At quick, one quiet thread took 90 s for fields, 85 s for the warm start and 88 s for psi."""
    text = said(tmp_path)
    assert text.startswith(
        ": about 7 min to 13 min (views 10 s, field 90 s, target_sets 16 s, warm_start 84 s, "
    )
    assert "psi 87 s, evaluate 4 min)" in text and "and up to 8 min more if psi takes all iterations" in text
    smoke = said(tmp_path, scale="smoke")
    assert (
        smoke.startswith(": about 46 s to 80 s")
        and "views 5 s, field 19 s, target_sets 1 s, warm_start 2 s" in smoke
    )


def test_a_slower_machine_takes_longer(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_layers", lambda: 2 * LAYERS)
    assert "(views 19 s, field 3 min)" in said(tmp_path, "stages=[views,field]")


def test_what_was_never_measured_is_named(tmp_path):
    text = said(tmp_path, "detector=fcos")
    assert "field 90 s" in text and text.endswith(
        "; not counting warm_start, psi, evaluate, unknown before a first run"
    )
    assert said(tmp_path, "detector=fcos", "stages=[evaluate]", "field=mlp").startswith(": about ")
    assert said(tmp_path, "stages=[preflight]").endswith("preflight, unknown before a first run")
    assert said(tmp_path, "workers=2") == ""


def test_photographs_and_their_masks_are_told_too(tmp_path):
    """80 CPU s took 49 photographs of 1,000 pixels with masks: 15 their views, 33 their masks, 13 the field."""
    capture(tmp_path / "shelf", "can", count=12, width=120, height=90)

    def of_photographs(*overrides):
        where = (f"objects.root={tmp_path / 'shelf'}", f"paths.store={tmp_path / 'store'}")
        config = composed("objects=photos", "objects.up=-y", "stages=[views,field]", *where, *overrides)
        context, tasks = context_of(config, tmp_path / "shelf" / "now")
        context.scale = "quick"
        return forecast(context, context.results.missing(s for t in tasks.values() for s in t.reads(context)))

    # 0.5 s, and 0.38 for each million of pixels, 1e5 more for each photograph; then 22.5 for each million of rays.
    assert "(views 1 s, field 15 s)" in of_photographs()
    assert "(views 17 s, field 15 s)" in of_photographs("objects.masks=scene")
    assert of_photographs("objects.refinement.rounds=6").endswith(
        "not counting views, unknown before a first run"
    )


def test_fewer_iterations_and_images_take_less(tmp_path):
    assert "up to" not in said(tmp_path, "outer.iterations=1")
    assert "warm_start 43 s" in said(tmp_path, "training.images_per_object=50")
    derivative = said(tmp_path, "baseline=neural_sim_derivative")
    assert "up to" not in derivative and "psi 9 min" in derivative


def test_the_last_run_like_it_is_believed_more(tmp_path):
    held = {"scale": "quick", "method": "neural_sim", "date": "2026-11-01 10:00", "left_out": [
        {"stage": "field", "seconds": 60.0}], "seconds": dict.fromkeys(
            ("views", "target_sets", "warm_start", "report", "psi", "evaluate"), 10.0)}  # fmt: skip
    before = tmp_path / "pose_gap" / "before"
    before.mkdir(parents=True)
    (before / "results.json").write_text(json.dumps(held))
    assert said(tmp_path) == ": about 2 min, as on 2026-11-01 10:00"
    (before / "results.json").write_text("{")
    assert said(tmp_path).startswith(": about 7 min to ")


def test_the_machine_is_timed_by_layers_that_take_a_moment(monkeypatch):
    monkeypatch.undo()
    assert 0.0 < module._layers() < 60.0 and min(MEASURED["field"]) > 0.0

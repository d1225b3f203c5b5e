"""``stages=[export]``: from objects and a psi to a data set, through the command line's own composition."""

import functools
import json
import shutil

import numpy as np
import pytest
import torch
from composing import composed
from filelock import FileLock
from PIL import Image

from neural_sim.cameras import reframed
from neural_sim.main import UserError, context_of
from neural_sim.stages.detail import cost_of, finer_fields, finer_recipe, view_size_for
from neural_sim.stages.store import locked
from neural_sim.synthesis.export.images import ImageSource
from neural_sim.target.coco import CocoTarget
from neural_sim.tasks import export as task
from neural_sim.tasks.walk import walk

SMALL = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "stages=[export]", "objects.names=[pitcher,drill]",
    "views.count=8", "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64",
    "export.width=48", "export.height=36",
    "export.count=3", "export.workers=0", "export.psi=target", "export.detail=run",
]  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("export")


def small(base, *overrides):
    paths = [f"paths.store={base / 'store'}", f"paths.mlflow={base / 'mlflow.db'}"]
    return composed(*SMALL, *paths, *overrides)


def export(base, folder, *overrides):
    context, others = context_of(small(base, *overrides), folder)
    walk(context, others)
    return folder / "dataset"


@pytest.fixture(scope="module")
def made(base):
    return export(base, base / "run", "export.formats=[coco,yolo,bop]")


def test_a_data_set_needs_objects_and_a_psi_alone(made):
    """Views and fields are made, and no target set and no detector is."""
    manifest = json.loads((made / "manifest.json").read_text())
    assert manifest["identity"]["classes"] == ["pitcher", "drill"]
    assert [image["number"] for image in manifest["images"]] == [0, 1, 2]
    assert {Image.open(made / image["file"]).size for image in manifest["images"]} == {(48, 36)}
    assert {path.name for path in made.iterdir()} == {
        "annotations.json", "bop", "dataset.yaml", "images", "labels", "manifest.json", "psi.csv", "psi.json",
        "records.jsonl", "samples.html", "segment",
    }  # fmt: skip
    kinds = {path.parent.name for path in (made.parents[1] / "store").rglob("*.pt")}
    assert kinds == {"views", "field"}
    loaded = CocoTarget(made / "annotations.json").load(["pitcher", "drill"], 36, 48)
    assert len(loaded) == 3 and bool(loaded.present.any())
    assert float(loaded.images.std()) > 0.05


def test_images_follow_the_psi_that_is_asked_for(base, made):
    """The dominant bin of the target is drawn most often, and the table says with which weight."""
    held = json.loads((made / "psi.json").read_text())
    config = small(base)
    wanted = config.parameter.pose.biased.pitcher.target.dominant
    weights = held["psi"]["pitcher"]["pose"]
    assert int(np.argmax(weights)) == wanted - 1 and weights[wanted - 1] == pytest.approx(0.86)
    rows = [row for row in held["rows"] if row["object"] == "pitcher" and row["factor"] == "pose"]
    assert [row["weight"] for row in rows] == pytest.approx(weights)


def _contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _killed(monkeypatch, base, folder, *overrides):
    """Export, and end in the middle of the third image."""
    draw = ImageSource.image

    def image(source, number):
        if number == 2:
            raise KeyboardInterrupt
        return draw(source, number)

    with monkeypatch.context() as patch:
        patch.setattr(ImageSource, "image", image)
        with pytest.raises(KeyboardInterrupt):
            export(base, folder, *overrides)


FORMATS = "export.formats=[coco,yolo,bop]"


def test_a_killed_export_goes_on_in_the_folder_of_the_next_run(base, made, tmp_path, monkeypatch):
    _killed(monkeypatch, base, tmp_path / "killed", FORMATS)
    assert len(list((tmp_path / "killed" / "dataset" / "images").iterdir())) == 2
    drawn, draw = [], ImageSource.image
    monkeypatch.setattr(ImageSource, "image", lambda *of: drawn.append(of[1]) or draw(*of))
    assert _contents(export(base, tmp_path / "next", FORMATS)) == _contents(made)
    assert drawn == [2] and not (tmp_path / "killed" / "dataset").exists()
    assert not list((base / "store" / "export").glob("*.checkpoint"))


def test_resume_false_begins_a_data_set_anew(base, made, tmp_path, monkeypatch):
    _killed(monkeypatch, base, tmp_path / "killed", FORMATS)
    assert _contents(export(base, tmp_path / "next", FORMATS, "resume=false")) == _contents(made)
    assert len(list((tmp_path / "killed" / "dataset" / "images").iterdir())) == 2


def test_a_data_set_that_another_run_works_on_is_left_alone(base, made, tmp_path, monkeypatch):
    _killed(monkeypatch, base, tmp_path / "other", FORMATS)
    with locked(tmp_path / "other" / ".dataset"):
        assert _contents(export(base, tmp_path / "next", FORMATS)) == _contents(made)
    assert len(list((tmp_path / "other" / "dataset" / "images").iterdir())) == 2
    # It is killed in the end, and its note was not lost when the same command finished meanwhile.
    assert _contents(export(base, tmp_path / "last", FORMATS)) == _contents(made)
    assert not (tmp_path / "other" / "dataset").exists()
    assert not list((base / "store" / "export").glob("*.checkpoint"))


def test_data_sets_do_not_wait_for_others_with_nearly_the_same_name(tmp_path):
    with (
        locked(task._lock_of(tmp_path / "set.v1")),
        locked(task._lock_of(tmp_path / "set.v2"), wait=False) as ours,
    ):
        assert ours


def test_the_folder_may_be_the_current_one(base, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    export(base, tmp_path / "run", "export.folder=.", "export.count=1")
    assert (tmp_path / "here" / "annotations.json").is_file()


def test_a_second_run_continues_the_folder(base, made, monkeypatch):
    """More images in the same folder; a psi read back from psi.json is the same psi."""
    before = {path.name: path.read_bytes() for path in (made / "images").iterdir()}
    psi = base / "psi.json"
    psi.write_bytes((made / "psi.json").read_bytes())
    again = [f"export.folder={made}", f"export.psi={psi}", "export.formats=[coco,yolo,bop]", "export.count=4"]
    export(base, base / "other", *again)
    after = {path.name: path.read_bytes() for path in (made / "images").iterdir()}
    assert len(after) == 4 and {name: after[name] for name in before} == before
    assert not (base / "other" / "dataset").exists()


def test_psi_is_read_from_a_runs_results(base, tmp_path):
    learned = {
        "learned": [0.3, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1],
        "initial": [0.125] * 8,
        "target": [0.125] * 8,
    }
    document = {"psi": {name: {"pose": learned} for name in ("pitcher", "drill")}}
    (tmp_path / "results.json").write_text(json.dumps(document))
    folder = export(base, tmp_path / "run", f"export.psi={tmp_path}", "export.count=1")
    held = json.loads((folder / "psi.json").read_text())["psi"]
    assert held["drill"]["pose"] == pytest.approx(learned["learned"])


def results(path, document):
    (path / "results.json").write_text(document if isinstance(document, str) else json.dumps(document))
    return f"export.psi={path}/results.json"


REFUSED = [
    (["export.count=0"], r"export\.count: want at least 1, got 0"),
    (["export.width=null"], r"export\.width: want width and height or neither, got None and 36"),
    (["export.formats=[coco,voc]"], r"export\.formats\[1\]: want one of coco, yolo, bop, got 'voc'"),
    (["export.formats=[]"], r"export\.formats: want 1 or more values and no repeated value, got \[\]"),
    (["export.image_format=gif"], r"export\.image_format: want one of jpg, png, got 'gif'"),
    (["export.workers=-1"], r"export\.workers: want at least 0 or null, got -1"),
    (["export.psi=/none"], r"export\.psi: want learned, initial, target, a run's folder.*, got /none, which does not"),
    (lambda path: [results(path, "{")], r"export\.psi: .*results\.json is not a results\.json or psi\.json"),
    (lambda path: [results(path, {"psi": {"pitcher": {"pose": [0.125] * 8}}})],
     r"export\.psi: .*results\.json has no psi of drill; want objects \['pitcher', 'drill'\] with \['pose'\]"),
    (lambda path: [results(path, {"psi": {name: {"pose": [0.5] * 2} for name in ("pitcher", "drill")}})],
     r"results\.json: pitcher\.pose: want 8 probabilities that add up to 1, got \[0\.5, 0\.5\]"),
    (lambda path: [results(path, {"psi": {n: {"pose": [1.2, -0.2, *[0.0] * 6]} for n in ("pitcher", "drill")}})],
     r"results\.json: pitcher\.pose: want 8 probabilities that add up to 1, got \[1\.2, -0\.2"),
    (["synthesis.objects_per_image=[1,3]"], r"synthesis\.objects_per_image: want at most 2, the number of objects"),
    (["parameter=[pose,zoom]", "parameter.zoom.by=focal_length", "parameter.zoom.range=[0.5,2.0]",
      "export.formats=[bop]", "synthesis.objects_per_image=[1,2]"],
     r"export\.formats: bop has one camera for all objects of an image"),
]  # fmt: skip


@pytest.mark.parametrize(("overrides", "message"), REFUSED)
def test_bad_settings_are_one_line_and_leave_nothing(overrides, message, base, tmp_path):
    given = overrides(tmp_path) if callable(overrides) else overrides
    with pytest.raises((ValueError, UserError), match=message) as caught:
        export(base, tmp_path / "run", *given)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


UNWRITABLE = ["export.folder=/proc/here"], r"^export\.folder: /proc/here cannot be written: "
OTHER = (
    ["export.folder={made}", FORMATS, "seed=9"],
    r"^export\.folder: the images of .* were made with seed=0, now it is 9",
)


@pytest.mark.parametrize(("overrides", "message"), [REFUSED[6], *REFUSED[-2:], UNWRITABLE, OTHER])
def test_bad_settings_are_refused_before_the_tasks_that_come_first(overrides, message, base, made, tmp_path):
    overrides = [text.format(made=made) if "{made}" in text else text for text in overrides]
    given = [f"paths.store={tmp_path / 'store'}", "stages=[views,export]", *overrides]
    with pytest.raises(ValueError, match=message):
        export(base, tmp_path / "run", *given)
    assert not (tmp_path / "store").exists()


def test_a_folder_that_cannot_be_locked_is_named_by_its_own_key(made, base, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(FileLock, "acquire", refuse)
    with pytest.raises(ValueError, match=r"^export\.folder: .* cannot be written: Permission denied$"):
        export(base, tmp_path / "run", f"export.folder={tmp_path / 'data'}")


def test_another_configuration_of_a_folder_is_refused_before_fields_are_fitted(
    base, made, tmp_path, monkeypatch
):
    monkeypatch.setattr(task, "farthest", None)  # comes after the fields
    for change, message in (("seed=9", r"made with seed=0, now it is 9"),
                            ("export.width=64", r"made with camera\.width=48, now it is 64"),
                            ("export.image_format=png", r"made with image_format=\"jpg\", now it is \"png\""),
                            ("export.psi=initial", r"made with psi\.pitcher\.pose=")):  # fmt: skip
        with pytest.raises(ValueError, match=rf"export\.folder: .*{message}"):
            export(base, tmp_path, f"export.folder={made}", "export.formats=[coco,yolo,bop]", change)


def test_views_for_larger_images_have_as_many_pixels_for_a_radius(base):
    """A square image of the views' field of view and nearest distance wants views of its own size."""
    context, _ = context_of(small(base, "unlearned.distance=[2.4,4.0]"), base / "unused")
    views, distribution = context.experiment.imaging.views, context.experiment.imaging.distribution
    assert view_size_for(views, views.camera(480), distribution, 1.0) in (480, 481)
    assert view_size_for(views, views.camera(480), distribution, 2.0) in (960, 961)


def test_a_finer_recipe_has_more_steps_and_cells_and_may_be_fitted(base):
    recipe = context_of(small(base), base / "unused")[0].experiment.imaging.field
    finer = finer_recipe(recipe, 3.0)
    assert isinstance(finer.fitting, functools.partial) and finer.steps == 60
    given = finer.fitting.keywords
    assert (given["resolution"], given["refine_steps"], given["prune_steps"]) == (256, (75,), (135,))
    assert recipe.fitting.keywords["resolution"] == 64  # the run's own stays
    fitting = finer.fitting(finer.field())
    assert fitting.resolution == 256
    assert torch.is_tensor(fitting.field.table)


def test_what_finer_fields_cost_is_said_before_they_are_fitted(made, base, tmp_path):
    """Those that the store has cost nothing; nothing is to be said where the run's own fields serve."""
    shutil.copytree(base / "store", tmp_path / "store")
    context, _ = context_of(small(base, f"paths.store={tmp_path / 'store'}"), base / "unused")
    graph, results = context.graph, context.results
    finer = finer_fields(graph, reframed(graph.camera, 384, 384), 192)
    assert cost_of(finer, graph.fields, results) == (
        "2 finer fields to fit first, each with 4.0 times the steps and 16 times the pixels of a field of the run; "
        "export.detail=run uses the run's fields instead"
    )
    left = [cost_of(finer, graph.fields, results)]
    for stage in finer:
        results.store.fetch(stage.kind, stage.key, stage.description, lambda: {"fitted": 1})
        left.append(cost_of(finer, graph.fields, results))
    assert [said.split(" to fit")[0] for said in left] == ["2 finer fields", "1 finer field", ""]
    assert cost_of(graph.fields, graph.fields, results) == ""

"""Photographs through the stages: views, fields, target sets that are rendered from fields or are photographs too."""

import pytest
import torch
from captures import capture
from composing import composed
from documented_data import coco, meshes

from neural_sim.field.scores import compare
from neural_sim.main import UserError, context_of
from neural_sim.objects.procedural import Procedural
from neural_sim.synthesis.subjects import MeshSubject, PhotographedField
from neural_sim.tasks.export import models_of
from neural_sim.tasks.walk import walk

SMALL = (
    "scale=smoke", "progress=false", "baseline=ns", "detector=micro", "objects=photos", "objects.up=-y", 
    "views.count=10",
    "views.image_size=40", "budget.grid.steps=20", "budget.grid.resolution=64", "training.cold_epochs=2",
    "training.warm_epochs=1", "training.images_per_object=4", 
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    capture(folder, "can", count=12, suffix=".jpg", exposure=0.1)
    capture(folder, "mug", count=12, kind="colmap_binary")
    return folder


WIDE = ("camera.width=48", "camera.height=32")


def started(root, folder, *overrides):
    where = [f"objects.root={root}", f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db"]
    return context_of(composed(*SMALL, *where, *overrides), folder)


def test_the_whole_way_with_a_target_rendered_from_fields(root, tmp_path):
    context, others = started(
        root, tmp_path, *WIDE, "stages=[views,field,target_sets,warm_start,psi,evaluate]"
    )
    assert walk(context, others) is not None
    graph, results = context.graph, context.results
    assert [stage.held_out for stage in graph.views] == [1, 1]
    views = results(graph.views[0])
    assert views.images.shape == (11, 40, 40, 4) and views.known is not None
    test = results(graph.targets).test
    assert test.images.shape[-2:] == (32, 48) and bool(test.present.any())
    # Over white, an image without the object is off by its silhouette's part of the pixels; the field is nearer.
    shown = views.images[-1:]
    alpha = shown[..., 3:]
    blank = compare(torch.zeros_like(shown), shown)
    assert 0.0 < float(alpha.mean()) < 1.0
    assert results(graph.fields[0]).history[-1]["psnr"] > blank["psnr"] + 3.0
    groups = graph.symmetry("can", "pose").make(results)
    assert sorted(b for group in groups for b in group) == list(range(1, 9))
    # A second run finds all that the first has stored.
    again, _ = started(root, tmp_path, *WIDE)
    assert again.graph.targets.key == graph.targets.key
    assert again.graph.views[0].key == graph.views[0].key


def test_a_target_of_photographs_needs_no_field(root, tmp_path):
    file = coco(tmp_path / "target" / "val.json")
    others = dict.fromkeys(("pitcher", "tall_box", "flat_box", "drill"))
    mapped = "target.categories={" + ",".join(f"{name}: null" for name in others) + "}"
    context, _ = started(
        root, tmp_path, "target=coco", f"target.annotations={file}", mapped, "camera=from_target",
        "camera.width=60", "stages=[target_sets]",
    )  # fmt: skip
    graph = context.graph
    assert graph.targets.fields == () and (graph.camera.width, graph.camera.height) == (60, 45)
    sets = context.results(graph.targets)
    assert sets.test.images.shape[-2:] == (45, 60)
    with pytest.raises(ValueError, match="nothing to render"):
        graph.objects.subject("can").maps(graph.camera, torch.eye(4)[None])


def test_meshes_beside_photographs_are_further_classes(root, tmp_path):
    scans = meshes(tmp_path / "meshes")
    beside = ["objects/beside=folder", f"objects.beside.root={scans}", "objects.beside.names=[ball,block]"]
    context, _ = started(root, tmp_path, *beside, "objects.names=[mug]")
    graph, results = context.graph, context.results
    assert graph.names == ("mug", "ball", "block")
    # Each is what it is alone, and found in the store by either run.
    alone, _ = started(root, tmp_path, "objects.names=[mug]")
    assert graph.fields[0].key == alone.graph.fields[0].key
    assert graph.objects.digests.keys() == set(graph.names)
    subjects = [graph.objects.subject(stage.views.object, results(stage).field) for stage in graph.fields]
    assert [type(subject) for subject in subjects] == [PhotographedField, MeshSubject, MeshSubject]
    assert [stage.held_out for stage in graph.views] == [1, 4, 4]
    assert [model.mesh is None for model in models_of(graph.objects)] == [True, False, False]
    # Photographs say which bins are left out for their own object alone.
    assert context.experiment.imaging.coverage.keys() == {"mug"}
    images = (
        results(graph.scene).training_set(graph.psi("initial"), 2, torch.Generator().manual_seed(0)).images
    )
    assert {int(label) for label in images.labels[images.present]} == {0, 1, 2}
    with pytest.raises(UserError, match=r"objects\.beside: 'ball' is also the name of a photographed object"):
        capture(tmp_path / "twice", "ball", count=4, item=Procedural(["can"]).load()[0])
        started(tmp_path / "twice", tmp_path, *beside)


def test_metres_want_a_size(root, tmp_path):
    metres = ["unlearned.distance_unit=metres", "unlearned.distance=[0.5,0.9]"]
    context, _ = started(root, tmp_path, *metres, "objects.size=0.2")
    assert context.graph.radii == (0.1, 0.1)
    context, _ = started(root, tmp_path, *metres, "objects.size={can: 0.2}")
    with pytest.raises(ValueError, match=r"nothing gives the size of mug: set objects\.size"):
        _ = context.graph.radii


def test_what_is_wrong_with_a_capture_is_said_before_any_stage(root, tmp_path):
    with pytest.raises(UserError, match=r"objects\.up: want one of"):
        started(root, tmp_path, "objects.up=sky")


def test_a_fields_image_has_straight_alpha(root, tmp_path):
    context, _ = started(root, tmp_path, "stages=[views,field]", "objects.names=[can]")
    field = context.results(context.graph.fields[0]).field
    views = context.results(context.graph.views[0])
    subject = context.graph.objects.subject("can", field)
    assert isinstance(subject, PhotographedField)
    maps = subject.maps(views.camera, views.camera_to_world[:2])
    rgb, opacity = subject.renderer.render(field, views.camera, views.camera_to_world[:2])
    torch.testing.assert_close(maps.rgb, rgb, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(maps.opacity, opacity)
    with pytest.raises(ValueError, match="can only be rendered under their light"):
        subject.maps(views.camera, views.camera_to_world[:1], torch.ones(1, 3))

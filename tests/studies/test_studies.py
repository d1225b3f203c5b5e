"""What studies need, and which methods, seeds and images they compare."""

import json
from pathlib import Path

import pytest
import torch
from composing import composed
from PIL import Image

from neural_sim.configuration import replaced
from neural_sim.main import UserError, context_of
from neural_sim.stages.reconstruction import ReconstructionStage
from neural_sim.stages.scene import LoadedImagesStage, MeshSubjectStage
from neural_sim.studies.nerf_vs_mesh import NerfVsMesh
from neural_sim.studies.sources import graphs_of_seeds
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.types import LabelledImages


def command(*overrides):
    """Of a command, with its other methods."""

    def again(more=()):
        return composed(*replaced(["scale=smoke", *overrides], more))

    return context_of(again(), Path("unused"), again)


@pytest.mark.parametrize(
    ("overrides", "keys"),
    [
        (
            ["+experiment=samples_gallery_ycb", "paths.data=nowhere"],
            ["objects.root", "YCB", "nowhere"],
        ),
        (
            ["+experiment=detection_gallery", "objects.root=."],
            ["target.annotations is not given", "COCO's format", "target.annotations=<file>"],
        ),
        (
            ["+experiment=detection_gallery", "objects.root=.", "target=ycb_video"],
            ["target.root is not given", "YCB-Video", "target.root=<folder>"],
        ),
        (
            ["+experiment=nerf_vs_mesh", "nerf_vs_mesh.blenderproc=nowhere"],
            ["nerf_vs_mesh.blenderproc", "coco_annotations.json", "in nowhere"],
        ),
    ],
    ids=["objects", "coco", "ycb_video", "blenderproc"],
)
def test_data_that_is_not_there_stops_the_run_with_one_line(overrides, keys):
    with pytest.raises(UserError) as caught:
        command(*overrides)
    assert all(key in str(caught.value) for key in keys) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        ["+experiment=nerf_vs_mesh", "nerf_vs_mesh.multiple=[3,2]"],
        ["+experiment=nerf_vs_mesh", "nerf_vs_mesh.seeds=0"],
        ["+experiment=nerf_vs_mesh", "nerf_vs_mesh.draws=1"],
        ["+experiment=samples_gallery", "samples_gallery.count=0"],
        ["+experiment=samples_gallery", "samples_gallery.methods=[ns,ns]"],
    ],
    ids=lambda words: words[1],
)
def test_bad_settings_are_refused_by_name(wrong):
    with pytest.raises(UserError, match=wrong[1].split("=")[0].split(".")[0]):
        command(*wrong)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+experiment=gumbel_temperature", "parameter=[pose,zoom]"], "want one parameter with bins"),
        (["+experiment=gumbel_temperature", "gradient=stratified"], "temperatures: want gradient=pathwise"),
    ],
    ids=lambda words: words[1] if isinstance(words, list) else "",
)  # fmt: skip
def test_what_a_study_cannot_measure_is_refused_before_anything_is_made(overrides, message):
    run, steps = command(*overrides)
    with pytest.raises(ValueError, match=message):
        for step in steps.values():
            list(step.reads(run))


def test_another_method_is_what_its_own_command_would_compose():
    """Apart from ``stages`` and the study's own node, which follow from the experiment."""
    run, _ = command("+experiment=samples_gallery", "baseline=ns", "seed=3")
    own, _ = command("+experiment=samples_gallery", "baseline=auto_sim", "seed=3")
    assert run.of_method("auto_sim").config == own.config and run.config != own.config
    assert run.experiment.loop.method.name == "ns" and run.of_method("ns").config == run.config
    with pytest.raises(Exception, match="baseline/theirs"):
        run.of_method("theirs")


def test_choices_take_the_place_of_those_of_the_same_group():
    given = ["+experiment=pose_gap", "baseline=ns", "+baseline.part=1", "seed=2"]
    assert replaced(given, ["baseline=lts"]) == [
        "+experiment=pose_gap",
        "+baseline.part=1",
        "seed=2",
        "baseline=lts",
    ]


def test_nerf_and_mesh_share_all_but_what_is_rendered():
    run, steps = command("+experiment=nerf_vs_mesh", "seed=5")
    first, second = graphs_of_seeds(run, 2)
    nerf, mesh = steps["nerf_vs_mesh"].sources(first).values()
    assert all(isinstance(subject, MeshSubjectStage) for subject in mesh.scene.subjects)
    assert nerf.key != mesh.key and mesh.scene.synthesizer is nerf.scene.synthesizer
    for name in ("detector", "training", "epochs", "probabilities", "seed", "psi"):
        assert getattr(nerf, name) is getattr(mesh, name)
    assert nerf.seed == 5 and steps["nerf_vs_mesh"].sources(second)["nerf"].seed == 6
    assert steps["nerf_vs_mesh"].sources(second)["mesh"].scene.names == first.names
    tests = steps["nerf_vs_mesh"].tests(first)
    assert [t.synthesizer.objects_per_image for t in tests.values()] == [(1, 1), (2, 4)]
    assert len(
        {t.key for t in tests.values()}
    ) == 2 and first.experiment.imaging.synthesis.objects_per_image == [1, 3]


@pytest.mark.parametrize("folder", ["", "coco_data"])
def test_blenderproc_images_take_the_place_of_the_mesh_renderers(tmp_path, folder):
    """Two pictures, of 48 x 48 pixels, of a mug and a can; the detector's images have 64."""
    output = tmp_path / "output"
    boxes, pixels = torch.tensor([[[8.0, 8.0, 24.0, 24.0]]] * 2), torch.zeros(2, 3, 48, 48)
    pixels[:, :, 8:24, 8:24] = 1.0
    images = LabelledImages(pixels, boxes, torch.tensor([[0], [1]]), torch.zeros(2, dtype=torch.long))
    (output / folder).mkdir(parents=True)
    write_coco(images, ["red mug", "can"], output / folder).rename(output / folder / "coco_annotations.json")
    run, _ = command("+experiment=nerf_vs_mesh")
    step = NerfVsMesh(blenderproc=str(output), categories={"red mug": "mug"})
    stage = step.sources(run.graph)["blenderproc"]
    assert isinstance(stage.scene, LoadedImagesStage)

    loaded = stage.images(run.results).images
    assert [run.graph.names[label] for label in loaded.labels[:, 0]] == ["mug", "can"]
    torch.testing.assert_close(loaded.boxes[:, 0], boxes[:, 0] * (64 / 48))
    key = stage.key
    document = json.loads((output / folder / "coco_annotations.json").read_text())
    document["annotations"][0]["bbox"][0] += 1
    (output / folder / "coco_annotations.json").write_text(json.dumps(document))
    other = NerfVsMesh(blenderproc=str(output), categories={"red mug": "mug"}).sources(run.graph)
    assert other["blenderproc"].key != key  # the contents are part of the key


def test_objects_of_photographs_alone_are_refused_before_anything_is_rendered(tmp_path):
    run, steps = command(
        "+experiment=nerf_vs_mesh", "target=coco", "target.annotations=" + str(_labels(tmp_path))
    )
    with pytest.raises(ValueError, match="want target=rendered"):
        list(steps["nerf_vs_mesh"].reads(run))


def _labels(folder):
    path = folder / "labels.json"
    document = {
        "images": [{"id": i, "file_name": f"{i}.png"} for i in range(2)],
        "annotations": [{"image_id": 0, "category_id": 1, "bbox": [2, 2, 4, 4]}],
        "categories": [{"id": 1, "name": "mug"}],
    }
    path.write_text(json.dumps(document))
    for image in document["images"]:
        Image.new("RGB", (8, 8)).save(folder / image["file_name"])
    return path


def test_a_reconstruction_is_what_the_store_gives_back(tmp_path):
    """From a cube's views without those held out, packed and unpacked."""
    run, _ = command("+experiment=sfm_vs_nerf", "objects.names=[flat_box]", "views.held_out=2")
    stage = ReconstructionStage(run.graph.views[0], 32)
    views = run.graph.views[0].make(None)

    def results(asked):
        assert asked is stage.views
        return views

    made = stage.make(results)
    again = stage.unpack(stage.pack(made))
    assert (again.vertices == made.vertices).all() and (again.faces == made.faces).all()
    assert (again.visual.vertex_colors == made.visual.vertex_colors).all()
    assert stage.views.held_out == 2 and len(views) == 22
    spoiled = views.images.clone()
    spoiled[-2:] = 0.0  # held out: not used
    views = type(views)(spoiled, views.camera_to_world, views.camera)
    assert (stage.make(results).vertices == made.vertices).all()


@pytest.mark.parametrize(
    "wrong", ["sfm_vs_nerf.resolution=100", "sfm_vs_nerf.seeds=0", "sfm_vs_nerf.draws=1"]
)
def test_bad_settings_of_the_reconstruction_are_refused(wrong):
    with pytest.raises(UserError, match=wrong.split("=")[0].split(".")[1]):
        command("+experiment=sfm_vs_nerf", wrong)

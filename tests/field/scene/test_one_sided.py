"""Photographs from one side of an object in a textured room, against photographs from all around of which they are a
part: which bins are named, and what of the object is there."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import on_a_table
from composing import composed
from PIL import Image

from neural_sim.main import context_of
from neural_sim.objects.procedural import Procedural
from neural_sim.objects.ycb import YCB
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.synthesis.subjects import MeshSubject
from neural_sim.tasks.walk import walk

pytestmark = pytest.mark.slow

COUNT, SIDE_DEG = 60, 120.0
DRAWN = 48


def scanned():
    """A drill of the YCB objects, else a mug."""
    root = Path(os.environ.get("NEURAL_SIM_DATA", Path(__file__).parents[4] / "shared"))
    return (YCB(root / "ycb", ["035"]) if (root / "ycb").is_dir() else Procedural(["mug"])).load()[0]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The made capture, and the runs on all its photographs and on those of one side, which score on the same ones."""
    made = on_a_table(
        tmp_path_factory.mktemp("all"), scanned(), count=COUNT, width=200, height=150, exposure=0.05,
        renderer=RaycastRenderer(1), suffix=".jpg",
    )  # fmt: skip
    written = json.loads((made.folder / "transforms.json").read_text())
    away = made.poses[:, :3, 3] - made.centre
    azimuth = np.degrees(np.arctan2(away[:, 2], away[:, 0]))  # its up is -y
    near = np.abs((azimuth - azimuth[0] + 180.0) % 360.0 - 180.0) <= 0.5 * SIDE_DEG
    side = [frame for frame, own in zip(written["frames"], near, strict=True) if own]
    test = [frame["file_path"] for frame in side[2::5]]
    found = {}
    for called, frames in (("all", written["frames"]), ("side", side)):
        rest = [frame["file_path"] for frame in frames if frame["file_path"] not in test]
        file = {**written, "frames": frames, "train_filenames": rest, "test_filenames": test}
        (made.folder / "transforms.json").write_text(json.dumps(file))
        found[called] = run(made.folder.parent, tmp_path_factory.mktemp(called))
    return made, found


def run(root, folder):
    said = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())
    logging.getLogger("neural_sim").addHandler(handler)
    context, tasks = context_of(
        composed("objects=photos", f"objects.root={root}", "objects.masks=scene", "objects.up=-y", "scale=quick",
            "views.image_size=96", "stages=[views,field]", "progress=false",
            f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db"),
        folder,
    )  # fmt: skip
    walk(context, tasks)
    logging.getLogger("neural_sim").removeHandler(handler)
    return context, said


def overlap(made, context):
    """The median intersection over union of the found masks with the true ones."""
    stage = context.graph.views[0]
    pictures = context.experiment.imaging.objects.pictures(stage.object, context.results(stage.masks))
    values = []
    for frame in pictures.capture.frames:
        mask = pictures.rgba(frame)[..., 3].numpy() > 0.5
        true = np.asarray(Image.open(made.folder / "truth" / f"{frame.image.stem}.png")) > 127
        values.append((mask & true).sum() / (mask | true).sum())
    return float(np.median(values))


def debris(made, context):
    """How much draws from p_psi show outside of the grown mesh, and inside of it, in parts of what the mesh shows."""
    graph, distribution = context.graph, context.experiment.imaging.distribution
    stage = graph.views[0]
    source = context.experiment.imaging.objects
    placement = source.placement(stage.object, source.pictures(stage.object, context.results(stage.masks)))
    mesh = made.mesh.copy().apply_transform(placement.to_object)
    camera = context.experiment.imaging.views.camera(96)
    noise = distribution.draw_noise(DRAWN, torch.Generator().manual_seed(0))
    draw = distribution.hard(graph.psi("initial")[0], noise)
    field = graph.objects.subject(stage.object, context.results(graph.fields[0]).field)
    shown = field.render(camera, distribution, draw).opacity
    true = MeshSubject("truth", mesh, RaycastRenderer(1)).render(camera, distribution, draw).opacity
    reach = 2 * round(96 / 24) + 1
    grown = torch.nn.functional.max_pool2d(true[:, None].float(), reach, 1, reach // 2)[:, 0] > 0.5
    return float(shown[~grown].sum() / true.sum()), float((shown * true).sum() / true.sum())


@pytest.fixture(scope="module")
def figures(runs):
    made, found = runs
    figures = {}
    for called, (context, _) in found.items():
        name = context.graph.names[0]
        stray, filled = debris(made, context)
        figures[called] = {
            "photographs": len(context.experiment.imaging.objects.captures[name].frames),
            "psnr": context.results(context.graph.fields[0]).psnr, "overlap": overlap(made, context),
            "debris": stray, "filled": filled,
            "missing": context.experiment.imaging.coverage[name]["pose"].missing,
        }  # fmt: skip
        print(called, figures[called])
    return figures


def test_bins_that_one_side_does_not_show_are_named_and_closed(runs, figures):
    """From the side, bins of a circle through the poles are seen from above and on one of its two sides."""
    (_, found), missing = runs, figures["side"]["missing"]
    assert len(missing) > len(figures["all"]["missing"])
    context, said = found["side"]
    (warning,) = (line for line in said if "no photograph is within" in line)
    assert ", ".join(map(str, missing)) in warning
    distribution = context.experiment.imaging.distribution
    p = distribution.probabilities(context.graph.psi("initial"))["pose"][0]
    assert all(float(p[number - 1]) == 0.0 for number in missing)


def test_what_one_side_shows_is_all_there(figures):
    assert figures["all"]["filled"] > 0.9 and figures["side"]["filled"] > 0.9
    assert figures["all"]["debris"] < 0.03


def test_one_side_is_as_good_as_all_around_where_both_look(figures):
    one, other = figures["side"], figures["all"]
    assert one["psnr"] > other["psnr"] - 1.0
    assert one["debris"] < 0.03

"""Whether a field shows its object: the page, the line on the console, and the refusal to train on debris."""

import logging
import re

import pytest
import torch
from captures import capture
from composing import composed

from neural_sim.field.quality import POOR, Quality
from neural_sim.main import context_of
from neural_sim.report.page.objects import ShownObject, write_objects_page
from neural_sim.stages.field import FittedField
from neural_sim.tasks.walk import walk

SMALL = (
    "scale=smoke", "progress=false", "objects=photos", "objects.up=-y", "views.count=10", "views.image_size=40",
    "budget.grid.steps=20", "budget.grid.resolution=64", "stages=[field]",
)  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    capture(folder, "can", count=12, width=120, height=90, angles=(0.2, 0.42))
    return folder


def started(root, folder, *overrides):
    where = [f"objects.root={root}", f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db"]
    return context_of(composed(*SMALL, *where, *overrides), folder)


def test_the_page_shows_photographs_masks_renders_and_bins(root, tmp_path, caplog):
    context, tasks = started(root, tmp_path)
    with caplog.at_level(logging.INFO):
        walk(context, tasks)
    page = (tmp_path / "objects.html").read_text()
    assert (
        len(re.findall("data:image/jpeg", page)) == 4 + 8
    )  # one held-out photograph in four pictures, eight bins
    (line,) = (r.getMessage() for r in caplog.records if r.getMessage().startswith("fields: can"))
    assert re.search(r"[\d.]+ dB, SSIM 0\.\d\d on the object in held-out photographs", line)
    assert str(tmp_path / "objects.html") in line
    graph, results = context.graph, context.results
    (quality,) = (results(stage) for stage in graph.qualities)
    assert quality.psnr == results(graph.fields[0]).psnr
    assert quality.bins["pose"].shape == (8, 96, 96, 3) and quality.photographs[0].dtype == torch.uint8
    p = graph.experiment.imaging.distribution.probabilities(graph.psi("initial"))["pose"][0]
    torch.testing.assert_close(p, torch.tensor([1, 1, 0, 0, 0, 0, 1, 0], dtype=torch.float64) / 3.0)
    # The placement again, from where the views' cameras are in both frames.
    placement = graph.objects.source.placement("can")
    assert quality.placed.radius == pytest.approx(placement.radius, rel=1e-3)
    centre = torch.tensor([*quality.placed.centre, 1.0], dtype=torch.float64)
    assert float((torch.from_numpy(placement.to_object) @ centre)[:3].norm()) < 1e-3
    # Cameras look down from 36 to 76 degrees off the vertical: no bin of the lower half is near one, and of the last
    # too few are.
    assert graph.experiment.imaging.coverage["can"]["pose"].missing == [3, 4, 5, 6, 8]
    assert page.count("no photograph near") == 5
    asks = "The field has 18 dB or more. Do you see the object, and all of it?"
    assert (asks in page) == (quality.psnr >= POOR) and "Photographs are dimmed where" in page
    (warning,) = (r.getMessage() for r in caplog.records if "no photograph is within" in r.getMessage())
    assert "5 of the 8 bins of parameter.pose: 3, 4, 5, 6, 8; they are left out" in warning


def test_the_headline_says_no_more_than_the_scores(tmp_path):
    def headline(*scores):
        views = tuple(torch.zeros(0, 4, 4, channels, dtype=torch.uint8) for channels in (3, 1, 3))
        shown = [
            ShownObject(name, Quality(psnr, None, None, views, (), {}, None), False, {})
            for name, psnr in zip("abc", scores, strict=False)
        ]
        page = write_objects_page("test", shown, tmp_path).read_text()
        return re.search(r'<p class="verdict[^>]*>([^<]*)', page)[1]

    assert (
        headline(20.0, 19.0) == "Every scored field has 18 dB or more. Do you see the object, and all of it?"
    )
    assert headline(20.0, 17.0, 12.0) == "b, c: the field does not show the object."
    assert headline(None) == "No field is scored."


def test_nothing_trains_on_debris_unless_told(root, tmp_path, monkeypatch):
    monkeypatch.setattr(FittedField, "psnr", 12.3)
    context, tasks = started(root, tmp_path, "objects.poor=refuse")
    (subject,) = context.graph.scene.subjects
    walk(context, tasks)  # the page itself is written
    assert "unusable" in (tmp_path / "objects.html").read_text()
    with pytest.raises(
        ValueError, match=r"can: its field has 12\.3 dB .*objects\.html.*objects\.poor=use accepts it"
    ):
        context.results(subject)
    context, _ = started(root, tmp_path, "objects.poor=use")
    (subject,) = context.graph.scene.subjects
    assert context.results(subject).name == "can"


def test_meshes_have_a_page_too(tmp_path, caplog):
    mesh = ("objects.names=[can,mug]", "views.count=6", "views.held_out=2", "views.backend=raycast")
    own = [each for each in SMALL if not each.startswith("objects")]
    where = [f"paths.store={tmp_path}/store", f"paths.mlflow={tmp_path}/mlflow.db"]
    context, tasks = context_of(composed(*own, *mesh, *where), tmp_path)
    with caplog.at_level(logging.INFO):
        walk(context, tasks)
    page = (tmp_path / "objects.html").read_text()
    assert len(re.findall("data:image/jpeg", page)) == 2 * (2 * 3 + 8)
    assert any(re.search(r"dB on 2 objects in held-out views", r.getMessage()) for r in caplog.records)
    assert context.experiment.imaging.coverage == {}

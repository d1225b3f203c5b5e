"""The figure of learned images, its distances and files."""

import json

import torch
from mlflow import MlflowClient

from neural_sim.studies.samples_gallery import Samples, publish, samples_figure, table
from neural_sim.types import LabelledImages


def images(count, value):
    pixels = torch.full((count, 3, 32, 32), value)
    return LabelledImages(
        pixels, torch.zeros(count, 1, 4), torch.zeros(count, 1).long(), torch.zeros(count).long()
    )


def samples(name="pitcher", distances=None):
    known = {"neural_sim": {"pose": 0.25}, "auto_sim": {"pose": 0.5}} if distances is None else distances
    return Samples(name, {"neural_sim": images(18, 0.2), "auto_sim": images(18, 0.4)}, images(7, 0.6), known)


def test_the_figure_has_a_panel_for_each_method_and_one_of_test_images():
    figure = samples_figure(samples(), 9)
    canvases = [axes.images[0].get_array() for axes in figure.axes]
    assert [round(float(canvas[0, 0, 0]), 3) for canvas in canvases] == [0.2, 0.4, 0.6]
    assert [canvas.shape[:2] for canvas in canvases] == [(65, 9 * 33 - 1)] * 2 + [(32, 9 * 33 - 1)]
    assert float(canvases[2][0, 7 * 33 + 5, 0]) == 1.0  # seven test images
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert (
        titles[0] == "neural_sim (total variation from the target: pose 0.25)" and titles[2] == "test images"
    )


def test_distances_are_tabled_where_the_target_is_known(context):
    unknown = samples("mug", {"neural_sim": None, "auto_sim": None})
    assert "| pitcher, pose | 0.25 | 0.50 |" in table([samples(), unknown]) and "mug" not in table(
        [samples(), unknown]
    )
    run = publish(context, [samples(), unknown], 9)
    document = json.loads((context.folder / "samples_gallery.json").read_text())
    assert (
        document["pitcher"]["images"] == {"neural_sim": 18, "auto_sim": 18} and document["mug"]["test"] == 7
    )
    assert {path.stem for path in (context.folder / "figures").iterdir()} == {"pitcher", "mug"}
    assert MlflowClient(context.uri).get_run(run.run_id).data.metrics == {
        "pitcher/pose/neural_sim": 0.25, "pitcher/pose/auto_sim": 0.5,
    }  # fmt: skip


def test_without_a_known_target_there_is_a_sentence_and_no_empty_table():
    assert "is unknown" in table([samples("mug", {"neural_sim": None, "auto_sim": None})])
    assert "|" not in table([samples("mug", {"neural_sim": None, "auto_sim": None})])


def test_words_of_a_figure_of_few_columns_are_not_cut_off():
    figure = samples_figure(samples(), 2)
    figure.draw_without_rendering()
    words = [figure._suptitle, *(axes._left_title for axes in figure.axes)]
    assert all(each.get_window_extent().x0 >= 0.0 for each in words)
    assert all(each.get_window_extent().x1 <= figure.bbox.x1 for each in words)
    first = words[1].get_window_extent()
    assert words[0].get_window_extent().y0 >= first.y1, (
        "the title of a tall figure is above its first caption"
    )

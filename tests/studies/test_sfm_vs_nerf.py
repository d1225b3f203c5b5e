"""The table and the figure of held-out views."""

import torch

from neural_sim.studies.sfm_vs_nerf import HeldOut, held_out_figure, held_out_table


def held(name, psnr):
    images = {
        row: torch.full((8, 8, 3), value) for row, value in (("view", 0.1), ("nerf", 0.2), ("sfm", 0.3))
    }
    scores = {
        s: {"psnr": psnr + i, "psnr_foreground": psnr - 5 + i, "ssim": 0.9}
        for i, s in enumerate(("nerf", "sfm"))
    }
    return HeldOut(name, images, scores)


BOTH = [held("can", 30.0), held("mug", 34.0)]


def test_the_table_has_every_object_and_the_mean():
    text = held_out_table(BOTH)
    assert "| object | nerf | nerf, object | sfm | sfm, object |" in text
    assert "| mug | 34.0 | 29.0 | 35.0 | 30.0 |" in text and "| mean | 32.0 | 27.0 | 33.0 | 28.0 |" in text


def test_the_figure_has_a_row_for_the_view_and_for_each_source():
    figure = held_out_figure(BOTH)
    shown = [float(axes.images[0].get_array()[0, 0, 0]) for axes in figure.axes]
    assert [round(value, 3) for value in shown] == [0.1, 0.1, 0.2, 0.2, 0.3, 0.3]
    assert [axes.get_title() for axes in figure.axes] == ["can", "mug", "", "", "", ""]
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["", "", "30.0 dB", "34.0 dB", "31.0 dB", "35.0 dB"]

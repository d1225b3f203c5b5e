"""The verdict before an optimisation: what is significant over all objects, what is advised, and the page."""

import dataclasses
import re

import torch

from neural_sim.baseline.label_shift.evidence import FactorEstimate
from neural_sim.outer.preflight import ExpectedGains, PhotographGain
from neural_sim.report.page.preflight import Preflight, write_preflight_page
from neural_sim.report.page.weak_bins import BinScore
from neural_sim.target.mismatch import Mismatch
from neural_sim.types import LabelledImages


def foreseen(name, p_value, step=0.1):
    return ExpectedGains(name, "pose", p_value, 0.15, (step, -step), (0.01, 0.01), step, 0.02)


def preflight(*p_values):
    rows = tuple(foreseen(f"object {i}", p, 0.1 * (i + 1)) for i, p in enumerate(p_values))
    bins = (BinScore("object 0", 1, 10, 0.5, {"ns": 0.8}), BinScore("object 0", 2, 10, 0.5, {"ns": 0.2}))
    size = Mismatch("box size", 0.4, 0.2, 0.9, 1e-9, 2)
    same = Mismatch("contrast", 0.2, 0.2, 0.5, 0.9, 2)
    return Preflight(
        "gap", ("object 0",), rows, 0.05, bins, (size, same), {"synthesis.sensor.blur": "[1,1]"}, 0.5
    )


def test_derivatives_count_by_the_level_over_all_of_them():
    # Holm: 0.01 <= 0.05 / 4, 0.016 <= 0.05 / 3, 0.03 > 0.05 / 2; the last, smaller than 0.05, does not count either.
    report = preflight(0.016, 0.01, 0.04, 0.03)
    assert [f.name for f in report.promising] == ["object 1", "object 0"]
    assert report.verdict.startswith("Worth optimising: object 1 and object 0") and "0.300" in report.verdict
    assert preflight(0.02, 0.03, 0.04).verdict.startswith("Not worth optimising")


def test_what_the_target_shows_is_worth_a_run_where_the_first_step_goes_there():
    estimates = tuple(
        FactorEstimate(
            name,
            "pose",
            30,
            (0.5, 0.5),
            (0.9, 0.1),
            (0.8, 0.0),
            (1.0, 0.2),
            ((1,), (2,)),
            0.01,
            0.5,
            0.9,
            finding,
        )
        for name, finding in (("drill", "moves"), ("mug", "stays"), ("can", "nearer"))
    )
    hopeless = dataclasses.replace(preflight(0.5), shown=estimates)
    assert hopeless.verdict.startswith("Not worth optimising")
    follows = dataclasses.replace(hopeless, follows=True)
    assert follows.verdict.startswith("Worth a run: your target shows drill and can differently from")
    assert follows.verdict.endswith("derivatives alone would move nothing.")
    both = dataclasses.replace(preflight(0.001), shown=estimates, follows=True)
    assert both.verdict.endswith("derivatives would move object 0.")
    still = dataclasses.replace(hopeless, shown=estimates[1:2], follows=True)
    assert still.verdict.startswith("Not worth optimising")


def test_the_summary_has_gains_weak_bins_and_advice():
    text = preflight(0.001, 0.5).summary()
    assert "1 (+0.1000 ± 0.0100 for 15% of its images)" in text
    assert "weak: object 0 from bin 2, AP 20.0 on 10 images" in text
    assert "differs: box size" in text and "differs: contrast" not in text
    assert "'synthesis.sensor.blur=[1,1]'" in text and "distances times 0.50" in text


def test_the_gain_is_told_in_labelled_photographs():
    report = preflight(0.001, 0.5)
    assert report.gain == 0.1 and "none are set aside for training" in report.worth
    counted = dataclasses.replace(
        report, labelled=(PhotographGain(10, 0.05, 0.01), PhotographGain(25, 0.2, None))
    )
    assert counted.worth.startswith("A first step is worth about 15 of them.")
    assert "10 lower it by 0.050 ± 0.010; 25 lower it by 0.200." in counted.summary()
    few = dataclasses.replace(report, labelled=(PhotographGain(10, 0.05, 0.01),))
    assert few.worth.startswith("A first step is worth more than 10 of them.")
    hopeless = dataclasses.replace(preflight(0.5), labelled=few.labelled)
    assert hopeless.worth.startswith("Labelled photographs, added to")


def test_the_page_is_self_contained(tmp_path):
    images = LabelledImages(
        torch.rand(4, 3, 24, 24), torch.zeros(4, 1, 4), torch.full((4, 1), -1), torch.zeros(4).long()
    )
    page = write_preflight_page(preflight(0.001, 0.5), images, images, tmp_path, {}).read_text()
    assert "Worth optimising: object 0" in page and "Box size differs" in page
    assert page.count('<th class="cell">') == 2
    assert all(source.startswith("data:image/") for source in re.findall(r'src="([^"]*)"', page))


def test_the_table_of_gains_has_a_heading_for_each_bin_of_any_factor(tmp_path):
    images = LabelledImages(
        torch.rand(1, 3, 24, 24), torch.zeros(1, 1, 4), torch.full((1, 1), -1), torch.zeros(1).long()
    )
    zoom = ExpectedGains("object 0", "zoom", 0.5, 0.15, (0.1,) * 5, (0.01,) * 5, 0.1, 0.02)
    report = dataclasses.replace(preflight(0.001), foreseen=(foreseen("object 0", 0.001), zoom))
    assert (
        write_preflight_page(report, images, images, tmp_path, {}).read_text().count('<th class="cell">') == 5
    )


def test_lights_are_not_said_to_be_read_right(tmp_path):
    """Their accuracy is a fraction of variance, which may be negative."""
    images = LabelledImages(
        torch.rand(1, 3, 24, 24), torch.zeros(1, 1, 4), torch.full((1, 1), -1), torch.zeros(1).long()
    )
    light = FactorEstimate("object 0", "illumination", 30, (0.5, 0.5), (0.9, 0.1), (0.8, 0.0), (1.2, 0.2),
                           ((1,), (2,)), 0.01, 0.5, -0.1, "not told apart", lights=True)  # fmt: skip
    report = dataclasses.replace(preflight(0.001), shown=(light,))
    page = write_preflight_page(report, images, images, tmp_path, {}).read_text()
    assert "0 % of the variance of guesses on held-out renders explained" in page and "read right" not in page


def test_bins_that_no_photograph_shows_have_no_gain(tmp_path):
    first = ExpectedGains("can", "pose", 0.01, 0.15, (None, -0.2, 0.1), (None, 0.01, 0.02), 0.1, 0.02)
    report = dataclasses.replace(preflight(0.5), foreseen=(first,))
    assert "3 (+0.1000 ± 0.0200 for 15% of its images)" in report.summary()
    images = LabelledImages(
        torch.rand(2, 3, 24, 24), torch.zeros(2, 1, 4), torch.full((2, 1), -1), torch.zeros(2).long()
    )
    page = write_preflight_page(report, images, images, tmp_path, {}).read_text()
    assert page.count("no photograph</span>") == 1 and "None" not in page


def test_what_the_target_shows_is_said_and_drawn(tmp_path):
    shown = (
        FactorEstimate(
            "object 0", "pose", 30, (0.5, 0.5), (0.9, 0.1), (0.81, 0.02), (0.97, 0.19), ((1,), (2,)), 0.005,
            0.07, 0.9, "moves",
        ),
        FactorEstimate(
            "object 0", "zoom", 30, (0.5, 0.5), (0.4, 0.6), (0.2, 0.4), (0.6, 0.8), ((1, 2),), 1.0, 0.8, 0.9,
            "fits no render",
        ),
    )  # fmt: skip
    report = dataclasses.replace(preflight(0.001), shown=shown)
    said = "your target shows the object 0 in pose bin 1 (0.81 to 0.97)"
    assert said in report.summary() and "boxes do not look like its renders" in report.summary()
    images = LabelledImages(
        torch.rand(2, 3, 24, 24), torch.zeros(2, 1, 4), torch.full((2, 1), -1), torch.zeros(2).long()
    )
    page = write_preflight_page(report, images, images, tmp_path, {}).read_text()
    assert "What the target shows" in page and page.count('alt="what the target shows') == 2 and said in page

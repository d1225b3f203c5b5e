"""The page of a comparison, on estimates that are given."""

import re
from dataclasses import replace

import pytest
from matplotlib.figure import Figure

from neural_sim.report.costs import HEAD, NOTE, Costs
from neural_sim.report.intervals import Estimate
from neural_sim.report.page.comparison_page import Section, verdict, write_comparison_page
from neural_sim.report.statistics import ONLY_AT_END, Comparison


@pytest.fixture
def comparison():
    methods = ("ours", "first", "second", "third")
    ahead = {
        "first": Estimate(0.2, 0.1, 0.3),
        "second": Estimate(-0.1, -0.2, -0.05),
        "third": Estimate(0.01, -0.1, 0.1),
    }
    return Comparison(
        "gap", (0, 1), methods, "ours", {m: Estimate(0.5, 0.4, 0.6) for m in (*methods, "ns", "matched")},
        {m: Estimate(0.9, 0.8, 1.0) for m in methods}, ahead, {"first": Estimate(0.2, 0.1, 0.3)},
        {m: {"images": 10.0, "detector_steps": 5.0, "products": 1.0, "seconds": 7.0} for m in methods},
        {m: Estimate(0.45) for m in methods}, 6.0, [5.0, 60.0],
        {"first": [Estimate(0.05, -0.1, 0.2), Estimate(0.15, 0.11, 0.2)]},
    )  # fmt: skip


def test_the_verdict_names_who_is_ahead_behind_and_not_told_apart(comparison):
    assert verdict(comparison) == (
        "ours reaches 50.0 AP (40.0 to 60.0), ahead of first by 20.0, behind second by 10.0, "
        "not told apart from third."
    )
    one = verdict(replace(comparison, seeds=(3,)))
    assert one.endswith("from third; one seed, so that how much trainings differ is not in this.")


def test_leads_of_runs_that_were_scored_once_do_not_stand_out(comparison, tmp_path):
    once = replace(comparison, only_at_end=True)
    page = write_comparison_page(
        [Section(once, Figure(figsize=(2, 2)), "", ["mug"], {})], {}, tmp_path
    ).read_text()
    assert ONLY_AT_END in page and page.count('class="accepted"') == 1 and page.count('class="rejected"') == 1


def test_a_page_has_every_method_and_what_was_left_out(comparison, tmp_path):
    spent = {"first": Costs(dict.fromkeys(HEAD, 3.0), 12.0, 700.0, None)}
    page = write_comparison_page(
        [Section(comparison, Figure(figsize=(2, 2)), "size=<1>", ["mug"], spent)],
        {"older & smaller": ["a run"]},
        tmp_path,
    ).read_text()
    assert "size=&lt;1&gt;" in page and "older &amp; smaller" in page  # escaped
    assert all(f"<th>{method}</th>" in page for method in comparison.methods)
    assert "data:image/svg+xml;base64," in page and not re.findall(r'(?:src|href)="(?!data:)', page)
    assert '<td class="accepted">\n20.0' in page or re.search(r'class="accepted">\s*20\.0', page)
    assert re.search(r'class="rejected">\s*-10\.0', page)
    cells = "".join(f'<td class="n">{cell}</td>' for cell in [*["3"] * len(HEAD), "700", "12", ""])
    assert f"<tr><th>first</th>{cells}</tr>" in page and NOTE in page
    row = page.split("<tr><th>ours ahead after so many s, of</th>")[1]
    assert re.match(r'<th class="n">5</th><th class="n">60</th></tr>\s*<tr><th>first</th>\s*<td>\s*5\.0', row)
    assert re.search(r'<td class="accepted">\s*15\.0 <span class="note">\(11\.0 to 20\.0\)', row)
    assert "95 %, over seeds and test images" in page


def test_differences_of_one_seed_do_not_stand_out(comparison, tmp_path):
    section = Section(replace(comparison, seeds=(0,)), Figure(figsize=(2, 2)), "", ["mug"], {})
    page = write_comparison_page([section], {}, tmp_path).read_text()
    assert 'class="accepted"' not in page and 'class="rejected"' not in page
    assert "95 %, over test images alone" in page and re.search(r"<td>\s*20\.0", page)

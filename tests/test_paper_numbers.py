"""The paper's numbers in conf/paper beside the lines of its LaTeX source that they are from."""

import pytest
from composing import composed
from omegaconf import OmegaConf

from neural_sim.configuration import conf_directory

NUMBERS = OmegaConf.to_container(OmegaConf.load(conf_directory() / "paper" / "numbers.yaml"))


CLAIMS = [(name, claim) for name, claims in NUMBERS["claims"].items() for claim in claims]


@pytest.mark.parametrize(("name", "claim"), CLAIMS, ids=[f"{name}-{claim['line']}" for name, claim in CLAIMS])
def test_a_claim_is_what_its_line_says(name, claim, paper_source):
    words = {"10 minutes": "ten minutes", "20 to 60": r"$20\%$ to $60\%$", "20 hours": "$20$ hours"}
    assert claim["quote"] in paper_source[claim["line"] - 1]
    assert words.get(claim["value"], str(claim["value"])) in claim["quote"]


@pytest.mark.parametrize("name", NUMBERS["tables"])
def test_a_table_has_the_numbers_of_its_lines(name, paper_source):
    """Each row's numbers stand in one line in their order; Table 1 is printed with methods as rows."""
    table = NUMBERS["tables"][name]
    first, last = table["lines"]
    lines = [
        line.replace("\\textbf{", "").replace("\\bf{", "").replace("}", "")
        for line in paper_source[first - 1 : last]
    ]
    rows = [[value for value in row if value is not None] for row in table["rows"].values()]
    if name == "table_1":
        printed = {
            line.split("&")[0].strip(): [] for line in lines if line.strip().startswith(("NS", "Auto", "NSO"))
        }
        for line in lines:
            if line.split("&")[0].strip() in printed:
                printed[line.split("&")[0].strip()] += [float(v.strip(" \\")) for v in line.split("&")[1:]]
        assert {m: [row[i] for row in rows] for i, m in enumerate(table["columns"])} == printed
        return
    for label, row in zip(table["rows"], rows, strict=True):
        cells = [[cell.strip(" \\").removesuffix("MB").strip() for cell in line.split("&")] for line in lines]
        (own,) = [each[1:] for each in cells if each[0] == label]
        assert [float(cell) for cell in own if cell != "N/A"] == row


def test_means_of_table_1_are_those_of_its_objects():
    """To a tenth: 21 numbers and their mean, each rounded to a tenth."""
    mean, *objects = NUMBERS["tables"]["table_1"]["rows"].values()
    assert len(objects) == 21
    for column in range(3):
        assert mean[column] == pytest.approx(sum(row[column] for row in objects) / 21, abs=0.1)


def test_every_number_is_on_the_page_or_belongs_to_an_experiment_to_come():
    rows = composed("+experiment=experiments_table").experiments.rows.values()
    claimed = {claim for row in rows for claim in row.get("claims", [])}
    assert set(NUMBERS["claims"]) == claimed
    assert set(NUMBERS["tables"]) == {row.table for row in rows if row.get("table")}

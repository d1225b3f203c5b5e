"""Equations and sections of the paper are cited by numbers that it prints."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
EQUATIONS = {"1", "2", "3", "4", "5", "6"}  # the LaTeX labels 8, 9, 11 and 15 print as 2, 3, 4 and 6
SECTIONS = {"1", "2", "3", "3.1", "3.2", "4", "4.1", "4.2", "4.3", "4.4", "4.5", "5", "A", "B", "C", "D"} | {
    f"{appendix}.{number}"
    for appendix, count in (("A", 6), ("B", 4), ("C", 4))
    for number in range(1, count + 1)
}
OTHERS = (
    "NeRF, ",
    "NeRF in the Wild",
    "Mildenhall",
    "Martin-Brualla",
    "Paulus",
    "Lin et al",
    "Golub",
    "Meyer",
    "Barron",
)
CITED = re.compile(r"(Eqs?|Secs?)\.\s+((?:[A-D]|\d+)(?:\.\d+)?(?:(?:, | and | to )(?:[A-D]\.|\d+\.?)\d*)*)")
FILES = [
    path
    for folder, pattern in (("src", "*.py"), ("conf", "*.yaml"), ("docs", "*.md"), ("benchmarks", "*.py"))
    for path in sorted((ROOT / folder).rglob(pattern))
] + [ROOT / "README.md"]


def wrong(text):
    """Citations of the paper by numbers that it does not have; those of other works name them just before."""
    for match in CITED.finditer(text):
        if any(name in text[max(0, match.start() - 60) : match.start()] for name in OTHERS):
            continue
        numbers = re.split(r", | and | to ", match.group(2))
        known = EQUATIONS if match.group(1).startswith("Eq") else SECTIONS
        yield from (f"{match.group(1)}. {n}" for n in numbers if n.rstrip(".") not in known)


def test_the_papers_numbers_exist():
    found = {str(path.relative_to(ROOT)): list(wrong(path.read_text())) for path in FILES}
    assert len(found) > 100 and not {path: numbers for path, numbers in found.items() if numbers}


def test_a_number_that_is_not_printed_is_found():
    assert list(wrong("left factor of Eq. 9 times v")) == ["Eq. 9"]
    assert list(wrong("(paper, Sec. 3.3)")) == ["Sec. 3.3"]
    assert list(wrong("Eqs. 3 to 7, Secs. 3, 3.2 and 4.6.")) == ["Eqs. 7", "Secs. 4.6"]
    assert not list(
        wrong("(paper, Sec. 3.1, Tool 1), (NeRF, Eq. 9), (Golub and Van Loan, Sec. 10.3), Sec. A.3.")
    )

from pathlib import Path

import pytest

from neural_sim.target.groups import groups_of

FILE = Path("val.json")
ENTRIES = [
    {"file_name": "kitchen/0001.jpg", "scene": 3},
    {"file_name": "kitchen/0002.jpg", "scene": 3},
    {"file_name": "hall/0001.jpg", "scene": "4"},
]


@pytest.mark.parametrize(
    ("split_by", "groups"),
    [
        (r"^(\w+)/", ["kitchen", "kitchen", "hall"]),
        (r"^\w+", ["kitchen", "kitchen", "hall"]),
        (r"\d+", ["0001", "0002", "0001"]),
        (r"^(\w)\w+/(\d+)", ["k", "k", "h"]),
        ("attribute:scene", ["3", "3", "4"]),
    ],
)
def test_groups_by_file_name_or_attribute(split_by: str, groups: list[str]) -> None:
    assert groups_of(ENTRIES, split_by, FILE) == groups


@pytest.mark.parametrize(
    ("split_by", "message"),
    [
        ("(", r"not a regular expression \(missing \)"),
        (r"^(\d+)/", r"3 of 3 images have no group, the first 'kitchen/0001\.jpg'"),
        (r"^(hall)/", r"2 of 3 images have no group, the first 'kitchen/0001\.jpg'"),
        (r"^kitchen(/)|hall", r"1 of 3 images have no group, the first 'hall/0001\.jpg'"),
        (r"\.jpg$", r"want at least two groups, got \['\.jpg'\]"),
        ("attribute:video", r"3 of 3 images have no group"),
        ("attribute:", r"3 of 3 images have no group"),
    ],
)
def test_what_makes_no_groups_is_refused_with_key_and_file(split_by: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        groups_of(ENTRIES, split_by, FILE)
    assert str(caught.value).startswith(f"target.split_by={split_by!r}, val.json: ")
    assert "\n" not in str(caught.value)


def test_an_attribute_must_be_a_text_or_a_number() -> None:
    with pytest.raises(ValueError, match=r"want a text or a number, got \{'id': 1\}"):
        groups_of([{"file_name": "a", "scene": {"id": 1}}, *ENTRIES], "attribute:scene", FILE)
    with pytest.raises(ValueError, match=r"1 of 4 images have no group, the first 'a'"):
        groups_of([{"file_name": "a", "scene": None}, *ENTRIES], "attribute:scene", FILE)

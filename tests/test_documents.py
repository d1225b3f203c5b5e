"""Standard JSON and Markdown tables."""

import errno
import json
import math
import os
from pathlib import Path

import pytest

from neural_sim.documents import finite, markdown_table, plain_table, read_json, write_json


def test_numbers_that_are_not_finite_become_null_at_every_depth(tmp_path):
    document = {"a": [1.0, math.nan, (math.inf, {"b": -math.inf})], "c": "nan", "d": True, "e": 3}
    path = write_json(tmp_path / "new" / "file.json", document)
    read = json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda name: pytest.fail(name))
    assert read == {"a": [1.0, None, [None, {"b": None}]], "c": "nan", "d": True, "e": 3}
    assert finite(math.nan) is None


def test_what_is_no_json_is_refused_with_its_path(tmp_path):
    assert read_json(write_json(tmp_path / "file.json", {"a": [1]})) == {"a": [1]}
    for text in (b"{", b"\xff", b"[" * 100_000, b'{"a":' * 100_000):
        (tmp_path / "broken.json").write_bytes(text)
        with pytest.raises(ValueError, match=r"broken\.json: not readable as JSON \("):
            read_json(tmp_path / "broken.json")
    with pytest.raises(ValueError, match=r"none\.json: not readable as JSON \("):
        read_json(tmp_path / "none.json")


def test_a_disk_that_is_full_leaves_the_earlier_file_and_names_it(tmp_path, monkeypatch):
    path = write_json(tmp_path / "file.json", {"a": 1})

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_json(path, {"a": 2})
    assert caught.value.filename == str(path) and caught.value.errno == errno.ENOSPC
    assert read_json(path) == {"a": 1} and [each.name for each in tmp_path.iterdir()] == ["file.json"]


def test_what_json_cannot_hold_is_refused(tmp_path):
    with pytest.raises(TypeError):
        write_json(tmp_path / "file.json", {"a": object()})


def test_a_table_has_its_head_its_rule_and_escaped_cells():
    assert markdown_table(["a", "b"], [[1, "x|y"], [None, 2.5]]) == (
        "| a | b |\n|---|---|\n| 1 | x\\|y |\n| None | 2.5 |"
    )
    with pytest.raises(ValueError, match=r"want 2 cells .* got \[1\]"):
        markdown_table(["a", "b"], [[1]])


def test_a_plain_table_wraps_long_titles_and_aligns_numbers_right():
    text = plain_table(
        ["", "before", "if the target were known"], [["a", "1.0", "22.5"], ["longer", "nan", "3.0"]]
    )
    assert text.splitlines() == [
        "                     if the",
        "                target were",
        "        before        known",
        "a          1.0         22.5",
        "longer     nan          3.0",
    ]
    pitcher = ["004_a_long_object_name", "12.3", "45.6", "45.6", "0.84 -> 0.08", "0.92 -> 0.10"]
    head = [
        "",
        "before",
        "after",
        "if the target were known",
        "pose, distance to target",
        "zoom, distance to target",
    ]
    assert max(map(len, plain_table(head, [pitcher]).splitlines())) <= 80, "a terminal has 80 columns"

"""`benchmarks/faults.py` in small: kills lose nothing, damage is not used."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_kills_lose_nothing_and_damage_is_not_used(tmp_path):
    command = [
        sys.executable,
        ROOT / "benchmarks" / "faults.py",
        "--kills",
        "3",
        "--terms",
        "1",
        "--damages",
        "60",
        "--together",
        "2",
    ]
    done = subprocess.run(
        [*command, "--out", tmp_path / "faults.json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=1200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads((tmp_path / "faults.json").read_text())
    for kind, status, count in (("kills", "-9", 3), ("terms", "143", 1)):
        ends = found[kind]
        assert ends["statuses"] == {status: count} and ends["same"] == ends["chains"] > 0
        assert not ends["different"] and ends["iterations_lost"] <= 1 and not ends["left_running"]
    assert found["damages"]["count"] == 60 and found["damages"]["used"] == 0
    together = found["together"]
    assert not together["failed"] and not together["different"] and not together["left_running"]

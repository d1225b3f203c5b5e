"""The scripts that lay out inputs of public bug reports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "shared" / "inputs"


def laid_out(number: str, out: Path) -> Path:
    """Run a script by its number and return its folder; without the scripts the test is skipped."""
    found = sorted(SCRIPTS.glob(f"{number}_*.py"))
    if not found:
        pytest.skip(f"no script {number} in {SCRIPTS}")
    subprocess.run([sys.executable, str(found[0]), str(out)], check=True, capture_output=True)
    return out

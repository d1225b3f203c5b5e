"""The commit of the code that runs."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@cache
def commit(package: Path = PACKAGE) -> str | None:
    """Seven digits of the checkout's commit, with ``-dirty`` where tracked files differ from it.

    None where ``package`` is not tracked by git, as when it is installed into a folder of another project, and where
    git does not answer.
    """
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    return _git(package, "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        command = ["git", "-C", str(folder), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()

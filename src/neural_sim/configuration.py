"""Where the configuration files are."""

from __future__ import annotations

from pathlib import Path


def conf_directory() -> Path:
    """The checkout's ``conf/`` where there is one, else the copy that travels in the wheel.

    Raises:
        FileNotFoundError: neither exists.
    """
    here = Path(__file__).resolve()
    for candidate in (here.parents[2] / "conf", here.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError(f"no conf/config.yaml beside {here.parents[2]} or in the installed package")

"""Find the configuration files, and name the folders of runs and sweeps."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path


class UserError(ValueError):
    """An error in the configuration or the input that the user can correct."""


def conf_directory() -> Path:
    """Find the checkout's ``conf/``, or the copy in the installed package.

    Raises:
        FileNotFoundError: neither exists.
    """
    here = Path(__file__).resolve()
    for candidate in (here.parents[2] / "conf", here.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return candidate
    raise FileNotFoundError(f"no conf/config.yaml in {here.parents[2]} or in the installed package")


LONGEST = 150
"""Largest number of characters in the name of a job's folder; file systems allow 255 bytes."""


def job_folder(number: int | str, overrides: str) -> str:
    """Name the folder of a sweep's job by its number and its overrides, cut to ``LONGEST`` characters.

    The file ``.hydra/overrides.yaml`` in the folder lists all overrides.
    """
    return f"{number}_{overrides}".replace("/", "-")[:LONGEST]


PHOTOGRAPHED = ("neural_sim.objects.photos.Photos", "neural_sim.objects.co3d.Co3d")
"""Classes of objects whose views are photographs."""


def view_size(source: str | None, of_meshes: int, of_photographs: int) -> int:
    """Choose the size of views by the class of the objects' source."""
    return of_photographs if source in PHOTOGRAPHED else of_meshes


def own_folder(wanted: Path) -> Path:
    """Make a new folder: ``wanted`` or, if that exists, ``wanted``_2, _3, ..."""
    folder, number = wanted, 1
    while True:
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}_{number}")


def named(overrides: Sequence[str], mode: str) -> bool:
    """Return whether a command names its folder itself; ``mode`` is ``run`` or ``sweep``."""
    return any(override.lstrip("+").startswith(f"hydra.{mode}.dir=") for override in overrides)


def leave_nothing(folder: Path) -> None:
    """Remove a refused run's folder if it holds nothing but Hydra's files, and the folders that this leaves empty."""
    held = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != ".hydra"]
    if any(path.suffix != ".log" or path.stat().st_size for path in held):
        return
    shutil.rmtree(folder, ignore_errors=True)
    for above in list(folder.parents)[:3]:
        try:
            above.rmdir()
        except OSError:  # it holds other runs
            return


def replaced(overrides: Sequence[str], choices: Sequence[str]) -> list[str]:
    """Return a command's overrides, with ``choices`` in place of those of the same groups."""
    chosen = {choice.partition("=")[0] for choice in choices}
    return [*(o for o in overrides if o.partition("=")[0].lstrip("+") not in chosen), *choices]


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message that is not empty; without a message, the name of its class."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[0].strip() if lines else type(error).__name__

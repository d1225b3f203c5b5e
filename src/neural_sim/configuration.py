"""Find the configuration files, name the folders of runs and sweeps, and translate old keys."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
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


GONE: dict[str, str] = {
    "baseline=none": "it meant Neural-Sim with its optimisation; want baseline=neural_sim, or baseline=ns for none",
    "gradient.relaxation": "gradient=pathwise always uses Gumbel-softmax draws; leave it out",
    "gradient.conditional_draws": "it was a setting of gradient.relaxation=gumbel_rao; leave it out",
    "gradient.antithetic": "it did not reduce errors; for less noise want gradient=stratified",
    "gradient.common_backgrounds": "it did not reduce errors; for less noise want gradient=stratified",
    "solver=neumann": "want solver=cg, or solver=minres for indefinite systems",
    "solver=nystrom": "want solver=cg, or solver=minres for indefinite systems",
    "outer.update._target_=neural_sim.parameter.update.Adam": "want neural_sim.parameter.update.Mirror or SGD",
    "outer.light_update._target_=neural_sim.parameter.update.Adam": "want neural_sim.parameter.update.Mirror or SGD",
    "baseline=random_search": "want baseline=lts, which learns from the same rewards",
    "baseline=bayes_opt": "want baseline=lts, which learns from the same rewards",
    "gradient.theta_mode=reverse": "it gained nothing; want forward or central_difference, with gradient=stratified",
    "outer.certify": "the reference is always the response of training; want outer.certify_every alone",
    "outer.certify_per_bin": "it belonged to outer.certify=retrained; leave it out",
    "baseline.max_step": "baseline=lts draws psi now; want baseline.deviation or baseline.learning_rate",
    "synthesis.label_gradient": "derivatives of boxes gained nothing (docs/paper.md); boxes are fixed labels",
}
"""The message for each key or choice (``key=value``) that no longer exists. A key stands for all keys below it, too."""

MOVED: dict[str, str] = {
    "baseline=neural_sim_paper_reinforce": "baseline=auto_sim_paper",
    "baseline=neural_sim_label_shift": "baseline=neural_sim",
    "objects.poses=given": "objects/poses=given",
    "objects.poses=colmap": "objects/poses=colmap",
    **{
        f"objects.poses.{key}": f"objects.refinement.{key}"
        for key in ("rounds", "updates", "image_size", "resolution", "steps", "batch_rays", "seed")
    },
    "budget.poses": "budget.refinement",
    "outer.steps=checked": "outer/steps=trust_region",
    "outer.steps=free": "outer/steps=free",
    "outer.checks": "outer.steps",
    "outer.update": "outer.steps.update",
    "outer.light_update": "outer.steps.light_update",
    "outer.final_step": "outer.steps.final_step",
    "outer.adjoint": "outer/adjoint",
    "outer.first_step=derivative": "outer/first_step=derivative",
    "outer.first_step=label_shift": "outer/first_step=label_shift",
    "outer.unrolled": "outer.adjoint",
    "outer.curvature_images": "outer.adjoint.curvature_images",
    "outer.trust.max_residual": "outer.adjoint.max_residual",
    "outer.trust.max_stationarity": "outer.adjoint.max_stationarity",
    "outer.trust.max_sensitivity": "outer.adjoint.max_sensitivity",
    "outer.on_untrusted": "outer.trust.on_untrusted",
    "outer.objective=average_precision": "outer/objective=smooth_ap",
    "outer.objective=accuracy": "outer/objective=smooth_accuracy",
    "outer.objective=loss": "outer/objective=loss",
    "outer.smooth_ap": "outer.objective",
    "outer.smooth_accuracy": "outer.objective",
}
"""Current names of keys and choices (``key=value``) that have moved.

A key stands for all keys below it, too, unless it has become a group, whose name has a slash:
``"outer.trust": "outer.adjoint.trust"`` moves ``outer.trust.level``, while ``"outer.adjoint": "outer/adjoint"`` leaves
``outer.adjoint.rtol`` alone.
"""


def updated(
    words: Sequence[str], gone: Mapping[str, str] = GONE, moved: Mapping[str, str] = MOVED
) -> tuple[list[str], list[str]]:
    """Translate the words of a command line to current names.

    Returns:
        The words, with moved keys and choices replaced, and one line for each replacement.

    Raises:
        UserError: a key or choice no longer exists.
    """
    current, notes = [], []
    for word in words:
        override = word.lstrip("+~")
        prefix = word[: len(word) - len(override)]
        key, equals, value = override.partition("=")
        for choice in (f"{key}={one}" for one in re.findall(r"[\w.]+", value)):
            if choice in gone:
                raise UserError(f"{choice} is gone: {gone[choice]}")
        for parent in _with_parents(key):
            if parent in gone:
                raise UserError(f"{parent} is gone: {gone[parent]}")
        renamed = _renamed(key, value, moved)
        if renamed is not None:
            name, translated = renamed
            # Hydra accepts a group of the defaults list only without a prefix.
            override = ("" if "/" in name else prefix) + name + equals + translated
            notes.append(f"{word} is now {override}")
            word = override
        current.append(word)
    return current, notes


def _renamed(key: str, value: str, moved: Mapping[str, str]) -> tuple[str, str] | None:
    """Return the current key and value (or values, in a sweep); None if nothing has moved."""
    words = [f"{key}={one}" for one in value.split(",")]
    choices = [moved.get(word, word).partition("=") for word in words]
    names = {name for name, _, _ in choices}
    if len(names) == 1 and any(word in moved for word in words):
        return names.pop(), ",".join(one for _, _, one in choices)
    for parent in _with_parents(key):
        if parent in moved and (parent == key or "/" not in moved[parent]):
            return moved[parent] + key[len(parent) :], value
    return None


def _with_parents(key: str) -> list[str]:
    """Return a dotted key and the keys above it, the longest first."""
    parts = key.split(".")
    return [".".join(parts[:count]) for count in range(len(parts), 0, -1)]


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message that is not empty; without a message, the name of its class."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[0].strip() if lines else type(error).__name__

"""The command line. The only module that reads a DictConfig: it turns each group into the object it names.

User errors become one line and exit status 2; inside a sweep a failed job raises, so that the others go on.
Heavy imports happen inside functions, so that ``--help`` answers at once.
"""

from __future__ import annotations

import logging
import os
import sys
import time
import types
import typing
import warnings
from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

if TYPE_CHECKING:
    from neural_sim.experiment import Experiment

# Read when torch is imported. OpenMP threads that spin starve each other where processes share cores (sweeps, tests);
# threads that sleep at once are woken for each of many short operations, which makes an outer iteration a third
# longer. So they spin for some tens of microseconds, then sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

_log = logging.getLogger(__name__)

# Groups whose mapping names a class or function (``_target_``); the rest are plain settings.
_GROUPS = ("objects", "views", "field", "renderer", "synthesis", "target", "detector", "solver", "baseline")
_SETTINGS = ("gradient", "outer", "training")


class UserError(ValueError):
    """Something in the configuration or the input that the user can mend."""


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


def build(config: DictConfig) -> Experiment:
    """Every part of an experiment from its group, validated before any stage runs.

    Raises:
        UserError: an unknown key, a value of the wrong type or out of range, with the key and what was got.
    """
    plain = _plain(config)
    from neural_sim.experiment import Experiment

    parts: dict[str, Any] = {name: _instantiate(plain[name], name) for name in (*_GROUPS, *_SETTINGS)}
    parameters = {name: _instantiate(node, f"parameter.{name}") for name, node in plain["parameter"].items()}
    if not parameters:
        raise UserError("parameter: want at least one of pose, zoom, illumination, got none")
    return Experiment(
        name=plain["name"],
        seed=plain["seed"],
        score_at=tuple(plain["score_at"]),
        stages=tuple(plain["stages"]),
        store=Path(plain["paths"]["store"]),
        mlflow=plain["paths"]["mlflow"],
        progress=plain["progress"],
        accelerator=plain["trainer"]["accelerator"],
        distribution=_product(
            parameters, parts | {"unlearned": _instantiate(plain["unlearned"], "unlearned")}
        ),
        config=plain,
        **parts,
    )


def _product(parameters: Mapping[str, Any], parts: Mapping[str, Any]) -> Any:
    """p_psi over all parameters, as far as views, renderer and estimator can serve it."""
    from neural_sim.parameter.product import SceneDistribution

    try:
        made = SceneDistribution.of(parameters.values(), parts["unlearned"])
    except ValueError as error:
        raise UserError(_first_line(error)) from error
    rig = parts["views"].rig
    if made.light is not None and (rig is None or rig.anchors != made.light.anchors):
        lights = "one fixed light" if rig is None else f"{rig.anchors} anchor lights"
        raise UserError(
            f"parameter.illumination: want renderer=nerf_w with {made.light.anchors} anchors, got {lights}"
        )
    return made


def stress(config: DictConfig, folder: Path) -> int:
    """Run the suite of ``conf/experiment/stress.yaml``, report in ``folder``; returns how many checks failed.

    Raises:
        UserError: an unknown key or family.
    """
    plain = _plain(config)
    suite = _instantiate(plain["stress"], "stress")
    from neural_sim.report.stress import report

    begun = time.time()
    return report(suite.run(plain["seed"], plain["progress"]), plain, folder, begun)


def _plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain values, its top level checked."""
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise UserError(f"{error.full_key or 'configuration'}: {_first_line(error)}") from error
    if not isinstance(plain, dict):
        raise UserError(f"the configuration must be a mapping, got {type(plain).__name__}")
    plain = {str(key): value for key, value in plain.items()}
    _check_top(plain)
    return plain


def _check_top(plain: Mapping[str, Any]) -> None:
    if isinstance(plain["seed"], bool) or not isinstance(plain["seed"], int) or plain["seed"] < 0:
        raise UserError(f"seed must be a whole number from 0, got {plain['seed']!r}")
    from neural_sim.pipeline import STAGES  # after what needs no heavy import to refuse

    if not isinstance(plain["stages"], list) or not plain["stages"]:
        raise UserError(f"stages must be a list of {', '.join(STAGES)}, got {plain['stages']!r}")
    for stage in plain["stages"]:
        if stage not in STAGES:
            raise UserError(f"stages: unknown stage {stage!r}, want some of {', '.join(STAGES)}")
    parts = isinstance(plain["score_at"], list) and all(
        type(at) in (int, float) and 0 < at <= 1 for at in plain["score_at"]
    )
    if not parts:
        raise UserError(
            f"score_at must be a list of parts of the method's iterations in (0, 1], got {plain['score_at']!r}"
        )
    if not isinstance(plain["progress"], bool):
        raise UserError(f"progress must be true or false, got {plain['progress']!r}")
    if plain["trainer"]["accelerator"] not in ("cpu", "gpu"):
        raise UserError(f"trainer.accelerator must be cpu or gpu, got {plain['trainer']['accelerator']!r}")


def _instantiate(node: Any, where: str) -> Any:
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(f"{where}: want a group with a _target_, got {node!r}")
    _check_arguments(node, where)
    try:
        return hydra.utils.instantiate(dict(node), _convert_="all")
    except Exception as error:  # Hydra wraps whatever the constructor raised
        cause = error.__cause__ or error
        if isinstance(cause, (ValueError, TypeError, FileNotFoundError, InstantiationException)):
            raise UserError(f"{where}: {_first_line(cause)}") from error
        raise


def _check_arguments(node: Mapping[str, Any], where: str) -> None:
    """Keys and scalar types against the constructor's signature, since plain YAML takes anything."""
    make = hydra.utils.get_object(node["_target_"])
    known = signature(make).parameters
    hints = typing.get_type_hints(make.__init__ if isinstance(make, type) else make)
    for key, value in node.items():
        if key.startswith("_"):
            continue
        if key not in known:
            raise UserError(f"{where}.{key}: unknown key, want one of {', '.join(known)}")
        if isinstance(value, Mapping) and "_target_" in value:
            _check_arguments(value, f"{where}.{key}")
        elif not _fits(value, hints.get(key, Any)):
            raise UserError(f"{where}.{key}: want {_type_name(hints[key])}, got {value!r}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a YAML scalar fits a type hint. Hints that are not about scalars are left to the constructor."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in typing.get_args(hint))
    if typing.get_origin(hint) is typing.Literal:
        return value in typing.get_args(hint)
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (str, bool):
        return isinstance(value, hint)
    if hint is type(None):
        return value is None
    return hint is Any or not isinstance(value, (str, int, float, bool, type(None)))


def _type_name(hint: Any) -> str:
    return getattr(hint, "__name__", None) if isinstance(hint, type) else str(hint).replace("typing.", "")  # pyright: ignore


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[0].strip() if lines else type(error).__name__


@hydra.main(version_base="1.3", config_path=str(conf_directory()), config_name="config")
def _task(config: DictConfig) -> float | None:
    runtime = HydraConfig.get()
    # Libraries on each other's deprecations: nothing that a user of this program can act on.
    warnings.filterwarnings("ignore", message=r".*torch\.jit\.script.*")
    warnings.filterwarnings("ignore", message=r".*LeafSpec.*")
    folder = Path(runtime.runtime.output_dir)
    try:
        if "stress" in config:
            return _finish_stress(stress(config, folder), runtime.mode)
        if "compare" in config:
            return _compare(config, folder)
        experiment = build(config)
        from neural_sim.pipeline import run
        from neural_sim.studies import STUDIES

        asked = STUDIES.keys() & set(config)
        for key in asked:
            STUDIES[key](experiment, _instantiate(_plain(config)[key], key), folder)
        return None if asked else run(experiment, folder)
    except (ValueError, FileNotFoundError) as error:
        if runtime.mode == RunMode.MULTIRUN:
            raise
        _log.debug("details", exc_info=True)
        print(f"neural-sim: {_first_line(error)}", file=sys.stderr)
        sys.exit(2)


def _compare(config: DictConfig, folder: Path) -> None:
    """Compare finished runs, as conf/experiment/compare.yaml says."""
    plain = _plain(config)
    comparison = _instantiate(plain["compare"], "compare")
    from neural_sim.report.tracking import tracking_uri

    comparison.run(tracking_uri(plain["paths"]["mlflow"]), plain["seed"], plain, folder)


def _finish_stress(failed: int, mode: RunMode | None) -> float:
    """Exit status 1 where a check failed; in a sweep the job raises, so that the others go on."""
    if failed and mode == RunMode.MULTIRUN:
        raise RuntimeError(f"stress: {failed} checks failed")
    if failed:
        sys.exit(1)
    return 0.0


def main() -> None:
    """Entry point of ``neural-sim`` and ``python -m src.main``."""
    _task()


if __name__ == "__main__":
    main()

"""The command line. The only module that reads a DictConfig: it turns each group into the object it names.

User errors become one line and exit status 2; inside a sweep a failed job raises, so that the others go on. SIGTERM and
Ctrl-C end the command, a sweep too, see ``interruption``.
Heavy imports happen inside functions, so that ``--help`` answers at once.
"""

from __future__ import annotations

import logging
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, TypedDict

import hydra
from annotated_types import MinLen
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from typing_extensions import override

from neural_sim.commandline import PATHS, checked, layout_of, present, worded
from neural_sim.configuration import (
    UserError,
    conf_directory,
    first_line,
    job_folder,
    leave_nothing,
    named,
    own_folder,
    replaced,
    view_size,
)
from neural_sim.declared import check_early
from neural_sim.guide import VERBS, answer, spoken
from neural_sim.interruption import interruptible
from neural_sim.ranges import NonNegativeInt, PositiveFraction, PositiveInt, check

if TYPE_CHECKING:
    from neural_sim.stages.experiment import Experiment
    from neural_sim.tasks.context import Context, Task

# Read when torch is imported. OpenMP threads that spin starve each other where processes share cores (sweeps, tests);
# threads that sleep at once are woken for each of many short operations, which makes an outer iteration a third
# longer. So they spin for some tens of microseconds, then sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

_log = logging.getLogger(__name__)

OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)
OmegaConf.register_new_resolver("view_size", view_size, replace=True)

# Top-level nodes that an experiment is built from, each with a ``_target_``. In addition, `parameter` has a node for
# each parameter.
_PARTS = (
    "objects", "views", "field", "renderer", "synthesis", "target", "camera", "detector", "solver", "baseline",
    "gradient", "outer", "training", "unlearned", "model",
)  # fmt: skip

# Types of top-level values.
_TOP = {
    "seed": NonNegativeInt,
    "stages": Annotated[list[str], MinLen(1)],
    "score_at": list[PositiveFraction],
    "progress": bool,
    "resume": bool,
    "workers": PositiveInt | Literal["ray"],
    "worker_gpus": PositiveFraction,
    "trainer": TypedDict("Trainer", {"accelerator": Literal["cpu", "gpu"]}),
}


def build(config: DictConfig) -> Experiment:
    """Build every part of an experiment from its group, all validated before any stage runs.

    Raises:
        UserError: a key is unknown, or a value has the wrong type or is out of range; the message has key and value.
    """
    return _build(_plain(config))


def _build(plain: dict[str, Any]) -> Experiment:
    from neural_sim.stages.experiment import Experiment, Imaging, Loop, Run

    parts: dict[str, Any] = {name: _instantiate(plain[name], name) for name in _PARTS}
    parameters = {name: _instantiate(node, f"parameter.{name}") for name, node in plain["parameter"].items()}
    if not parameters:
        raise UserError("parameter: want at least one of pose, zoom, illumination, got none")
    run = Run(
        name=plain["name"],
        seed=plain["seed"],
        store=Path(plain["paths"]["store"]),
        mlflow=plain["paths"]["mlflow"],
        accelerator=plain["trainer"]["accelerator"],
        progress=plain["progress"],
        resume=plain["resume"],
        workers=plain["workers"],
        worker_gpus=plain["worker_gpus"],
        score_at=tuple(plain["score_at"]),
        task=plain["task"],
    )
    parts["objects"] = _with_cameras(parts["objects"], run)
    images = {name: parts[name] for name in ("objects", "views", "field", "renderer", "synthesis", "target")}
    distribution, covered = _covered(_product(parameters, parts), parameters, parts["objects"])
    imaging = Imaging(**images, camera=_camera(parts), distribution=distribution, coverage=covered)
    loop = Loop(parts["baseline"], parts["outer"], parts["gradient"], parts["solver"])
    return Experiment(run, imaging, parts["detector"], parts["training"], loop, plain, parts["model"])


Recompose = Callable[[Sequence[str]], DictConfig]
"""Takes choices as overrides, and returns the configuration of the same command with them."""


def context_of(
    config: DictConfig, folder: Path, recompose: Recompose | None = None
) -> tuple[Context, dict[str, Task]]:
    """Return the context of a command in ``folder``, and its tasks by name: first the phases of a run, in their order.

    If phases of a run are asked for, the experiment is built at once, so that bad settings are refused before anything
    else. With ``recompose``, tasks can build the experiment of another method.

    Raises:
        UserError: as ``build``, and for an unknown entry of ``stages``.
    """
    plain = _plain(config)
    tasks = [name for name in plain["stages"] if isinstance(plain.get(name), Mapping)]
    parts = () if len(tasks) == len(plain["stages"]) else (*_PARTS, "parameter")
    for name in (*tasks, *parts):
        check_early(plain[name], name)
    from neural_sim.tasks.context import Context
    from neural_sim.tasks.walk import PHASES

    phases = {name: phase for name, phase in PHASES.items() if name in plain["stages"]}
    others: dict[str, Task] = {}
    for name in plain["stages"]:
        if name in PHASES:
            continue
        if not _is_task(plain.get(name)):
            known = [*PHASES, *(key for key, value in plain.items() if _is_task(value))]
            raise UserError(f"stages: unknown stage {name!r}, want some of {', '.join(known)}")
        others[name] = _instantiate(plain[name], name)
    context = Context(plain, folder, lambda: _build(plain), (*phases, *others))
    if recompose is not None:
        context.of_method = lambda method: _build(_plain(recompose([f"baseline={method}"])))
    if phases:
        _ = context.experiment
    return context, {**phases, **others}


def _is_task(node: Any) -> bool:
    if not isinstance(node, Mapping) or "_target_" not in node:
        return False
    from neural_sim.tasks.context import Task

    kind = hydra.utils.get_object(node["_target_"])
    return isinstance(kind, type) and issubclass(kind, Task)


def _camera(parts: Mapping[str, Any]) -> Any:
    """Return the camera of synthesised images and of rendered target images."""
    views = parts["views"]
    try:
        return parts["camera"].camera(parts["training"].image_size, views.field_of_view_deg, parts["target"])
    except ValueError as error:
        raise UserError(first_line(error)) from error


def _with_cameras(objects: Any, run: Any) -> Any:
    """Return the objects; if photographs have no cameras, these are computed, or read from the store."""
    from neural_sim.objects.photos import Photos
    from neural_sim.stages.cameras import with_cameras
    from neural_sim.stages.stage import Results
    from neural_sim.stages.store import Store

    if not isinstance(objects, Photos):
        return objects
    try:
        return with_cameras(objects, Results(Store(run.store)), run.progress)
    except ValueError as error:
        raise UserError(first_line(error)) from error


def _covered(distribution: Any, parameters: Mapping[str, Any], objects: Any) -> tuple[Any, Any]:
    """Return p_psi, without uncovered bins unless they are to be rendered, and which bins photographs cover."""
    from neural_sim.objects.photos import Photos
    from neural_sim.parameter.coverage import coverages
    from neural_sim.parameter.pose import Pose

    pose = next((own for own in parameters.values() if isinstance(own, Pose)), None)
    if pose is None or not isinstance(objects, Photos):
        return distribution, {}
    seen = {name: objects.directions(name) for name in objects.names()}
    found = coverages(distribution, seen, pose.covered_within_deg)
    if pose.uncovered == "render":
        return distribution, found
    try:
        return distribution.leaving_out(found), found
    except ValueError as error:
        raise UserError(first_line(error)) from error


def _product(parameters: Mapping[str, Any], parts: Mapping[str, Any]) -> Any:
    """Return p_psi over all parameters, and refuse anchor lights that the views do not have."""
    from neural_sim.parameter.product import SceneDistribution

    try:
        distribution = SceneDistribution.of(parameters.values(), parts["unlearned"])
    except ValueError as error:
        raise UserError(first_line(error)) from error
    rig = parts["views"].rig
    if distribution.lights and (rig is None or rig.anchors != distribution.lights):
        lights = "one fixed light" if rig is None else f"{rig.anchors} anchor lights"
        raise UserError(
            f"parameter.illumination: want renderer=nerf_w with {distribution.lights} anchors, got {lights}"
        )
    return distribution


def _plain(config: DictConfig) -> dict[str, Any]:
    """Return the configuration as plain values, its top level checked."""
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        if isinstance(error, MissingMandatoryValue):
            key = str(error.full_key)
            wanted = (config.get("needs") or {}).get(key) or f"{PATHS.get(key, 'a value')}, {key}=..."
            raise UserError(f"{key} is not given: want {wanted}") from error
        raise UserError(f"{error.full_key or 'configuration'}: {first_line(error)}") from error
    if not isinstance(plain, dict):
        raise UserError(f"the configuration must be a mapping, got {type(plain).__name__}")
    plain = {str(key): value for key, value in plain.items()}
    for key, hint in _TOP.items():
        check(plain[key], hint, key)
    return plain


def _instantiate(node: Any, where: str) -> Any:
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(f"{where}: want a group with a _target_, got {node!r}")
    check(node, Any, where)
    try:
        return hydra.utils.instantiate(dict(node), _convert_="all")
    except Exception as error:  # Hydra wraps whatever the constructor raised
        cause = error.__cause__ or error
        inner = re.search(r"^full_key: (\S+)", str(error), re.MULTILINE)
        if isinstance(cause, (ValueError, TypeError, FileNotFoundError, InstantiationException)):
            raise UserError(_with_key(first_line(cause), node, where, inner[1] if inner else "")) from error
        raise


def _with_key(message: str, node: Mapping[str, Any], where: str, inner: str) -> str:
    """Return a constructor's message, which may begin with ``Class.argument``, with the whole key instead."""
    made: Any = node
    for key in filter(None, inner.split(".")):
        made, where = made.get(key) if isinstance(made, Mapping) else None, f"{where}.{key}"
    made = made["_target_"].rpartition(".")[2] if isinstance(made, Mapping) else ""
    if message.startswith((f"{where}.", f"{where}:")):
        return message
    rest = message.removeprefix(f"{made}.")
    return f"{where}: {message}" if rest == message else f"{where}.{rest}"


@hydra.main(version_base="1.3", config_path=str(conf_directory()), config_name="config")
def _task(config: DictConfig) -> float | None:
    runtime = HydraConfig.get()
    folder = Path(runtime.runtime.output_dir)
    # Warnings of libraries about each other's deprecations, which a user of this program cannot act on.
    warnings.filterwarnings("ignore", message=r".*torch\.jit\.script.*")
    warnings.filterwarnings("ignore", message=r".*LeafSpec.*")
    try:
        given = list(runtime.overrides.task)
        name = runtime.job.config_name
        context, tasks = context_of(config, folder, lambda more: hydra.compose(name, replaced(given, more)))
        context.command = shlex.join(["python", "-m", "src.main", *given])
        context.scale = str(runtime.runtime.choices.get("scale", ""))
        from neural_sim.tasks.walk import walk

        return walk(context, tasks)
    except (ValueError, OSError) as error:
        if runtime.mode == RunMode.MULTIRUN:
            raise
        if not named(runtime.overrides.hydra, "run"):
            leave_nothing(folder)
        _refuse(error)
    except RuntimeError as error:
        from neural_sim.tasks.context import TaskFailure

        if runtime.mode == RunMode.MULTIRUN or not isinstance(error, TaskFailure):
            raise
        sys.exit(1)


class RefuseStudies(Callback):
    """Stops a study whose data is missing or whose settings are wrong before its first job.

    A study, here, is an experiment with a sweep of its own, ``hydra.sweeper.params``. All its jobs would fail in the
    same way.
    """

    @override
    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        if not config.hydra.sweeper.get("params"):
            return
        job = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        try:
            context_of(job, Path())
        except (ValueError, FileNotFoundError) as error:
            _refuse(error)


class OwnFolder(Callback):
    """Gives each run or sweep its own folder, even if another one of the experiment starts in the same second.

    Folders are named by date and time. A folder that the command line names is used as it is.
    """

    @override
    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        self._take(config, "run")
        folder = Path(config.hydra.run.dir)
        try:  # Hydra would make it too, but print a stack trace of two screens if that fails
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            _refuse(
                UserError(f"hydra.run.dir: {folder} cannot be made ({error.strerror}); name another folder")
            )

    @override
    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        if self._take(config, "sweep"):
            with read_write(config):  # each job composes its configuration anew
                config.hydra.overrides.hydra.append(f"hydra.sweep.dir='{config.hydra.sweep.dir}'")

    def _take(self, config: DictConfig, mode: str) -> bool:
        if named(config.hydra.overrides.hydra, mode):
            return False
        with read_write(config):
            config.hydra[mode].dir = str(own_folder(Path(config.hydra[mode].dir)))
        return True


class SweepTable(Callback):
    """Ends a sweep with a table of its runs."""

    @override
    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        from neural_sim.report.run import sweep_table

        folder = Path(config.hydra.sweep.dir)
        if folder.is_dir() and (table := sweep_table(folder)):
            print(table)


def _refuse(error: Exception) -> NoReturn:
    """Print an error as one line, and exit with status 2."""
    _log.debug("details", exc_info=True)
    line = first_line(error)
    if isinstance(error, OSError) and error.filename is not None:
        line = f"{error.filename}: {error.strerror}; finished results are kept"
    print(f"neural-sim: {line}", file=sys.stderr)
    sys.exit(2)


def main() -> None:
    """Run ``neural-sim`` or ``python -m src.main``."""
    logging.raiseExceptions = False  # a log on a full disk would print a stack trace for each of its lines
    with interruptible():
        layout = layout_of(sys.argv[1:], conf_directory())
        if layout is not None and (said := answer(sys.argv[1:], layout)) is not None:
            print(said)
            return
        try:
            sys.argv[1:] = spoken(sys.argv[1:])
            if layout is not None:
                checked(sys.argv[1:], layout, VERBS)
                present(sys.argv[1:])
            # Errors are raised here instead of printed by Hydra in many lines.
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")
            _task()
        except UserError as error:
            _refuse(error)
        except HydraException as error:
            _refuse(UserError(worded(error, layout)))


if __name__ == "__main__":
    main()

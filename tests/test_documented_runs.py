"""Every documented run as it is written, through the command line, at smoke scale, on data made here and on one store:
it ends well and leaves what the documentation promises. Sweeps are cut to their first seed, and scales that take hours
to smoke. Comparisons come last, after the runs that they compare."""

import os
import subprocess
import sys

import pytest
import torch
from composing import composed
from documented import ROOT, commands
from documented_checks import check_of
from documented_data import MadeData, with_given_cameras
from filelock import FileLock

pytestmark = pytest.mark.slow


def _configuration(job):
    return composed(*job)


def _compares(command):
    return any(word.startswith("compare.") or word == "+experiment=compare" for word in command.overrides)


def _exports(command):
    return bool({"stages=[export]", "+experiment=photographs"} & set(command.overrides))


def _reads_psi(command):
    return bool({"stages=[export]", "viewer.psi=learned"} & set(command.overrides))


class Runs:
    """Runs commands once each, in folders of their own under one root, with one store and one MLflow, whichever of
    the test's processes asks first."""

    def __init__(self, root, data):
        self.root, self.data = root, data

    def words(self, command):
        """The overrides at smoke scale, with the first of the seeds and made data for paths."""
        written = command.cut(1) if command.multirun else command.overrides
        kept = [
            self.data.localise(word) for word in with_given_cameras(written) if not word.startswith("scale=")
        ]
        few = ["export.count=3", "export.width=64", "export.height=48"] if _exports(command) else []
        if "stages=[viewer]" in command.overrides:
            kept.append("viewer.seconds=1")
        if "+experiment=sample_data" in command.overrides:
            kept.append(f"sample.folder={self.root / 'shelf'}")
        if few:  # into folders of the test's own
            kept = [f"export.folder={self.root / 'exported'}" if "folder=" in word else word for word in kept]
        return [*kept, *few, "scale=smoke"]

    def folder(self, command):
        """Where the command left its files, which it must have done without an error."""
        folder = self.root / "runs" / str(ALL.index(command))
        folder.parent.mkdir(parents=True, exist_ok=True)
        ended = folder.with_suffix(".ended")
        with FileLock(folder.with_suffix(".lock")):
            if not ended.exists():
                self._run(command, folder)
                ended.touch()
        return folder

    def _run(self, command, folder):
        added = [f"paths.store={self.root / 'store'}", f"paths.mlflow={self.root / 'mlflow.db'}"]
        added.append(f"paths.data={self.data.shared}")
        added.append(f"hydra.{'sweep' if command.multirun else 'run'}.dir={folder}")
        run = [sys.executable, "-m", "src.main", *sorted(command.flags), *self.words(command), *added]
        done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=3000)
        assert done.returncode == 0, (
            f"{command.where}: {' '.join(run)}\n{done.stdout[-1000:]}{done.stderr[-3000:]}"
        )


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    processes = tmp_path_factory.getbasetemp()
    together = processes.parent if "PYTEST_XDIST_WORKER" in os.environ else processes
    return Runs(together / "documented", MadeData(tmp_path_factory.mktemp("documented_data")))


ALL = [command for command in commands("main") if "--help" not in command.flags]


def _reads_runs(command):
    return _compares(command) or "+experiment=experiments_table" in command.overrides


@pytest.mark.parametrize("command", sorted(ALL, key=_reads_runs), ids=lambda command: command.where)
def test_a_documented_run_runs_and_leaves_what_it_promises(command, runs):
    jobs = command.jobs(seeds=1)
    shared = f"paths.data={runs.data.shared}"
    configurations = [_configuration([*(runs.data.localise(word) for word in job), shared]) for job in jobs]
    if (
        any(config.trainer.accelerator == "gpu" for config in configurations)
        and not torch.cuda.is_available()
    ):
        pytest.skip("no CUDA device")
    if _compares(command):
        _run_what_is_compared(runs, set(configurations[0].compare.experiments))
    if _reads_psi(command):
        _run_what_was_learned(runs, command)
    folder = runs.folder(command)
    folders = [path.parent.parent for path in folder.glob("**/.hydra/config.yaml")]
    assert len(folders) == len(jobs)
    for job, config in zip(folders, [_of(path) for path in folders], strict=True):
        check = check_of(config)
        check(job, config)


def _of(folder):
    from omegaconf import OmegaConf

    return OmegaConf.to_container(OmegaConf.load(folder / ".hydra" / "config.yaml"), resolve=True)


def _run_what_is_compared(runs, experiments):
    for command in ALL:
        if command.multirun and experiments & {_configuration(job).name for job in command.jobs(seeds=1)}:
            runs.folder(command)


def _run_what_was_learned(runs, command):
    """A learned psi is that of the same command without its stage."""
    rest = [word for word in command.overrides if not word.startswith(("stages=", "export.", "viewer."))]
    if not any(word.startswith("export.psi=") for word in command.overrides):
        runs.folder(next(other for other in ALL if other.overrides == rest and not other.multirun))


def test_help_lists_the_keys():
    done = subprocess.run(
        [sys.executable, "-m", "src.main", "--help", "keys"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert all(f"\n{key}:\n" in done.stdout for key in ("views", "training", "outer", "objects"))


def test_mlflow_knows_the_documented_options():
    environment = {**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true"}
    done = subprocess.run(
        [sys.executable, "-m", "mlflow", "ui", "--help"],
        capture_output=True,
        text=True,
        timeout=300,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    options = {word for command in commands("mlflow") for word in command.arguments if word.startswith("--")}
    assert options and all(option in done.stdout for option in options)

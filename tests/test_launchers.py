"""Jobs of a sweep side by side: the presets of conf/hydra/launcher compose, and run a sweep as Hydra alone does."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from neural_sim import extras
from neural_sim.commandline import checked, layout_of
from neural_sim.configuration import UserError, conf_directory

ROOT = Path(__file__).parents[1]
LAUNCHERS = {
    "local": "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher",
    "slurm": "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher",
    "slurm_local": "hydra_plugins.hydra_submitit_launcher.submitit_launcher.LocalLauncher",
}
SWEEP = [
    "+experiment=pose_gap", "scale=smoke", "progress=false", "baseline=ns,label_shift", "detector=micro",
    "views.count=8", "views.held_out=2", "budget.grid.steps=20", "budget.grid.resolution=64",
    "training.cold_epochs=30", "target.val_per_object=8", "objects.names=[pitcher,drill]",
]  # fmt: skip
installed = pytest.mark.skipif(bool(extras.missing_of("sweeps")), reason="the extra sweeps is not installed")


def test_there_is_no_other_launcher():
    assert {
        path.stem for path in (conf_directory() / "hydra" / "launcher").glob("*.yaml")
    } == LAUNCHERS.keys()


@installed
@pytest.mark.parametrize("name", LAUNCHERS)
def test_a_launcher_composes(name):
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        config = compose("config", [f"hydra/launcher={name}", "hydra.sweep.dir=x"], return_hydra_config=True)
    made = config.hydra.launcher
    assert made._target_ == LAUNCHERS[name]
    assert made.n_jobs == 2 if name == "local" else made.timeout_min == 240
    assert name != "slurm" or made.max_num_timeout == 20


def test_a_launcher_that_is_not_installed_is_refused_with_the_command_that_installs_it(monkeypatch):
    words = ["hydra/launcher=local", "seed=0,1"]
    layout = layout_of(words, conf_directory())
    assert layout is not None
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"^hydra/launcher=local: .* pip install 'neural-sim\[sweeps\]'$"):
        checked(words, layout)
    checked(["hydra/launcher=basic"], layout)


@installed
@pytest.mark.slow
@pytest.mark.parametrize("name", ["local", "slurm_local"])
def test_a_sweep_of_two_jobs_leaves_what_one_after_another_leave(name, tmp_path, empty_store):
    alone, together = (_sweep(tmp_path, empty_store, each) for each in ("basic", name))
    assert len(alone) == 2 and alone == together


def _sweep(folder, database, launcher):
    """Return the scores and psi of every job by its folder."""
    root = folder / launcher
    root.mkdir()
    shutil.copy(database, root / "mlflow.db")
    command = [
        sys.executable, "-m", "src.main", "-m", *SWEEP, f"hydra/launcher={launcher}", f"paths.store={root}/store",
        f"paths.mlflow={root}/mlflow.db", f"hydra.sweep.dir={root}/jobs",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    found = {path.parent.name: json.loads(path.read_text()) for path in root.glob("jobs/*/results.json")}
    return {name: (results["ap"], results["psi"]) for name, results in found.items()}

"""A whole run with `trainer=gpu`, on the pretended device, beside the same run on the CPU."""

import json

import pytest
import torch
from composing import composed

from neural_sim import devices
from neural_sim.main import context_of
from neural_sim.tasks.walk import walk

RUNS = {
    "stratified": [],
    "pathwise": ["gradient=pathwise"],
    "light": ["renderer=nerf_w", "parameter=[pose,illumination]"],
}


def _results(folder, trainer, overrides):
    paths = [f"paths.store={folder}/store", f"paths.mlflow={folder}/mlflow.db", f"trainer={trainer}"]
    chosen = [
        "+experiment=pose_gap",
        "scale=smoke",
        "progress=false",
        "objects.names=[pitcher,drill]",
        *paths,
    ]
    context, others = context_of(composed(*chosen, *overrides), folder / "run")
    torch.manual_seed(0)  # layers of a field's colour head
    walk(context, others)
    return json.loads((folder / "run" / "results.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_run_on_a_gpu_gives_what_the_cpu_gives(tmp_path, pretend, monkeypatch, name):
    monkeypatch.setitem(devices.DEVICES, "gpu", "pretend")
    monkeypatch.setattr(devices, "CACHES", 1)  # sums in the CPU's pieces have its rounding
    here, there = (_results(tmp_path / trainer, trainer, RUNS[name]) for trainer in ("cpu", "gpu"))
    assert pretend.calls > 10_000
    for scores in (here["fields"], there["fields"]):
        for history in scores.values():
            history.pop("seconds")
    assert there["fields"] == here["fields"] and there["ap"]["ns"] == here["ap"]["ns"]
    for object_name, factors in here["psi"].items():
        for factor, psi in factors.items():
            assert there["psi"][object_name][factor]["learned"] == pytest.approx(psi["learned"], abs=1e-3)

"""From photographs to detections on new pictures, through the command line."""

import json
import subprocess
import sys
import time

import pytest
from captures import capture
from documented import ROOT

pytestmark = pytest.mark.slow


def _run(folder, *overrides):
    stored = [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}", "progress=false"]
    command = [sys.executable, "-m", "src.main", *overrides, *stored]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1500)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    return done.stdout


def test_photographs_become_a_detector_that_is_scored_on_exported_images(tmp_path):
    for name, kind in (("can", "transforms"), ("mug", "colmap_text")):
        capture(tmp_path / "captures", name, count=16, kind=kind, suffix=".jpg")
    begun = time.perf_counter()
    objects = ["objects=photos", f"objects.root={tmp_path / 'captures'}", "scale=smoke", "name=chain"]
    run, data, seen = (tmp_path / part for part in ("run", "data", "seen"))
    printed = _run(tmp_path, *objects, f"hydra.run.dir={run}")
    assert printed.strip().endswith(str(run / "report.html"))
    results = json.loads((run / "results.json").read_text())

    export = [
        "stages=[export]",
        "export.count=6",
        "export.width=96",
        "export.height=72",
        "export.formats=[coco,yolo,bop]",
    ]
    _run(tmp_path, *objects, *export, f"export.folder={data}", f"hydra.run.dir={tmp_path / 'export'}")
    rows = json.loads((data / "psi.json").read_text())["rows"]
    for name, factors in results["psi"].items():
        weights = [row["weight"] for row in rows if (row["object"], row["factor"]) == (name, "pose")]
        assert weights == pytest.approx(factors["pose"]["learned"], abs=1e-9)
    assert set(results["psi"]) == {"can", "mug"}

    predict = ["stages=[predict]", f"predict.model={run}", f"predict.images={data / 'images'}"]
    _run(tmp_path, *predict, f"predict.annotations={data / 'annotations.json'}", f"hydra.run.dir={seen}")
    scores = json.loads((seen / "scores.json").read_text())
    assert scores["images"] == 6 and set(scores["per_class"]) == {"can", "mug"}
    assert len(list((seen / "pictures").iterdir())) == 6
    print(f"\n{time.perf_counter() - begun:.0f} s from photographs to detections")

"""AP of detectors from fields of photographs: exact ones, a telephone's, and a telephone's with corrected poses.

Photographs of three YCB objects over clutter, by a distorted lens, with masks, as a COLMAP model. Those of a telephone
have poses off by 1 % of the distance and brightness off by 10 %. The detector trains on uniform poses and is scored on
renders of the meshes with blur and noise.

    python benchmarks/photographs.py --root ../shared/ycb --out outputs/benchmarks/photographs
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from captures import capture
from hydra import compose, initialize_config_dir

from neural_sim.configuration import conf_directory
from neural_sim.main import context_of
from neural_sim.objects.ycb import YCB
from neural_sim.renderer.views import choose_mesh_renderer
from neural_sim.synthesis.export.coco import write_coco
from neural_sim.types import LabelledImages

KINDS = {"exact": (0.0, 0.0), "telephone": (0.01, 0.1)}
"""Deviations of positions, in distances, and of log brightness."""


def make_captures(options: argparse.Namespace) -> None:
    renderer = choose_mesh_renderer("auto", 1)
    for kind, (noise, exposure) in KINDS.items():
        for item in YCB(options.root, options.names).load():
            capture(
                options.out / kind, item.name, item=item, count=options.photos, width=500, height=375,
                scale=item.radius, renderer=renderer, pose_noise=noise, exposure=exposure, suffix=".jpg",
                kind="colmap_text",
            )  # fmt: skip


def make_target(options: argparse.Namespace, names: list[str]) -> Path:
    """Labelled test images, as COCO."""
    overrides = [
        f"scale={options.scale}", "objects=ycb", f"objects.root={options.root}", f"objects.names=[{','.join(names)}]",
        "synthesis.sensor.noise=[0.01,0.03]", "synthesis.sensor.blur=[0.3,0.9]",
    ]  # fmt: skip
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        config = compose("config", [*overrides, *stored(options.out)])
    context, _ = context_of(config, options.out / "target")
    sets = context.results(context.graph.targets)
    return Path(write_coco(LabelledImages.concatenate([sets.val, sets.test]), names, options.out / "target"))


def stored(folder: Path) -> list[str]:
    return [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}", "progress=false"]


def score(options: argparse.Namespace, kind: str, rounds: int, annotations: Path) -> dict[str, float]:
    """AP by class, from photographs to a scored detector by the command line."""
    folder = options.out / f"run_{kind}_{rounds}"
    command = [
        sys.executable, "-m", "src.main", f"scale={options.scale}", "baseline=ns", "objects=photos", "objects.up=-y",
        f"objects.root={options.out / kind}", f"objects.poses.rounds={rounds}", "target=coco",
        f"target.annotations={annotations}", "target.val_fraction=0.25", f"hydra.run.dir={folder}",
        *stored(options.out),
    ]  # fmt: skip
    subprocess.run(command, check=True, cwd=Path(__file__).parents[1], stdout=subprocess.DEVNULL)
    return json.loads((folder / "results.json").read_text())["ap"]["ns"]["per_class"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True, help="a folder in the YCB layout")
    parser.add_argument("--names", nargs="*", default=["019_pitcher_base", "025_mug", "035_power_drill"])
    parser.add_argument("--photos", type=int, default=40)
    parser.add_argument("--scale", default="quick")
    parser.add_argument("--out", type=Path, required=True, help="a new folder")
    options = parser.parse_args()
    options.root, options.out = options.root.resolve(), options.out.resolve()
    make_captures(options)
    annotations = make_target(options, options.names)
    for kind, rounds in (("exact", 0), ("telephone", 0), ("telephone", 6)):
        ap = score(options, kind, rounds, annotations)
        each = ", ".join(f"{name} {100 * value:.1f}" for name, value in ap.items())
        print(
            f"{kind}, {rounds} rounds of correction: {each}, mean {100 * sum(ap.values()) / len(ap):.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()

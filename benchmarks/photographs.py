"""Take photographs to a detector: with exact poses, with a phone's, and with a phone's after refinement.

Photographs show three YCB objects over clutter through a distorted lens, with masks and a COLMAP model. Those of a
phone have poses with errors of 1 % of the distance, and brightness with errors of 10 %. Target images are renders of
the meshes with blur and noise, mostly from one side for the pitcher and the drill; the psi loop starts from uniform
poses. The last run also exports a data set from its psi and predicts with its detector.

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
"""Standard deviations of positions, relative to the distance, and of log brightness."""
TARGET = {"019_pitcher_base": 3, "035_power_drill": 7}
"""Dominant pose bins of the target's images, one-based; other objects have uniform poses."""


def make_captures(options: argparse.Namespace) -> None:
    """Photograph every object, exactly and as a phone would."""
    renderer = choose_mesh_renderer("auto", 1)
    for kind, (noise, exposure) in KINDS.items():
        for item in YCB(options.root, options.names).load():
            capture(
                options.out / kind, item.name, item=item, count=options.photos, width=500, height=375,
                scale=item.radius, renderer=renderer, pose_noise=noise, exposure=exposure, suffix=".jpg",
                kind="colmap_text",
            )  # fmt: skip


def make_target(options: argparse.Namespace, names: list[str]) -> Path:
    """Write labelled target images in COCO format."""
    biased = ",".join(f"{name}:{{target:{{dominant:{TARGET[name]}}}}}" for name in names if name in TARGET)
    overrides = [
        f"scale={options.scale}", "objects=ycb", f"objects.root={options.root}", f"objects.names=[{','.join(names)}]",
        "synthesis.sensor.noise=[0.01,0.03]", "synthesis.sensor.blur=[0.3,0.9]",
        f"parameter.pose.biased={{{biased}}}",
    ]  # fmt: skip
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        config = compose("config", [*overrides, *stored(options.out)])
    context, _ = context_of(config, options.out / "target")
    sets = context.results(context.graph.targets)
    return Path(write_coco(LabelledImages.concatenate([sets.val, sets.test]), names, options.out / "target"))


def stored(folder: Path) -> list[str]:
    """Return the overrides that keep stores in the folder."""
    return [f"paths.store={folder / 'store'}", f"paths.mlflow={folder / 'mlflow.db'}", "progress=false"]


def run(options: argparse.Namespace, folder: Path, *overrides: str) -> Path:
    """Run the command line in a folder, and return the folder."""
    command = [sys.executable, "-m", "src.main", *overrides, f"hydra.run.dir={folder}", *stored(options.out)]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[1], stdout=subprocess.DEVNULL)
    return folder


def of_photographs(options: argparse.Namespace, kind: str, rounds: int) -> list[str]:
    """Return the overrides that use the photographs as objects."""
    return [
        f"scale={options.scale}", "objects=photos", "objects.up=-y", f"objects.root={options.out / kind}",
        f"objects.refinement.rounds={rounds}",
    ]  # fmt: skip


def printed(what: str, ap: dict[str, float]) -> None:
    """Print the AP of each class and the mean."""
    each = ", ".join(f"{name} {100 * value:.1f}" for name, value in ap.items())
    print(f"{what}: {each}, mean {100 * sum(ap.values()) / len(ap):.1f}", flush=True)


def main() -> None:
    """Run from photographs to predictions."""
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
        objects = of_photographs(options, kind, rounds)
        target = ["target=coco", f"target.annotations={annotations}", "target.val_fraction=0.25"]
        folder = run(options, options.out / f"run_{kind}_{rounds}", *objects, *target)
        results = json.loads((folder / "results.json").read_text())
        for what, ap in results["ap"].items():
            printed(f"{kind}, {rounds} rounds of correction, {what}", ap["per_class"])
    run(
        options, options.out / "exported", *objects, "stages=[export]", f"export.psi={folder}", "export.count=200",
        f"export.folder={options.out / 'export'}",
    )  # fmt: skip
    predicted = run(
        options, options.out / "predicted", "stages=[predict]", f"predict.model={folder}",
        f"predict.images={annotations.parent / 'images'}", f"predict.annotations={annotations}",
    )  # fmt: skip
    scores = json.loads((predicted / "scores.json").read_text())
    printed(f"predicted, all {scores['images']} images of the target", scores["per_class"])


if __name__ == "__main__":
    main()

"""Compare ways to raise the AP on photographs of a real object, of a detector trained on renders of it.

The object is the flowerpot in `<shared>/captures`, reconstructed from its unlabelled photographs, without given cameras
or masks; five scanned YCB objects are the other classes. Detectors are scored on the labelled photographs in
tests/data/flowerpot.json, close-ups in which the upper edge of the image cuts the pot off. The backgrounds called
`scene` are the unlabelled photographs with the pot erased.

    python benchmarks/flowerpot.py --shared ../shared --out outputs/benchmarks/flowerpot
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir
from PIL import Image
from scipy.ndimage import binary_dilation, gaussian_filter

from neural_sim.configuration import conf_directory
from neural_sim.documents import markdown_table
from neural_sim.main import context_of
from neural_sim.objects.photos import Photos

ROOT = Path(__file__).parents[1]
LABELS = ROOT / "tests" / "data" / "flowerpot.json"
OTHERS = ["002", "019", "024", "025", "035"]
"""A can, a pitcher, a bowl, a mug and a drill."""
CAMERA = ["camera.width=96", "camera.height=71", "camera.fx=82"]
"""Field of view of the phone, from the focal length that COLMAP found: 854 pixels for a width of 1,000."""
CUT = ["synthesis.shift=0.5"]
SCENE = [*CUT, "synthesis=photos", "synthesis.background.root={scene}"]
SENSOR = ["synthesis.sensor.blur=[0,1]", "synthesis.sensor.noise=[0,0.03]"]
RUNS = {
    "clutter": ["baseline=ns"],
    "clutter, label shift": ["baseline=label_shift"],
    "clutter, cut by the edge": [*CUT, "baseline=ns"],
    "scene, cut by the edge": [*SCENE, "baseline=ns"],
    "the same with blur and noise": [*SCENE, *SENSOR, "baseline=ns"],
    "the same, label shift": [*SCENE, *SENSOR, "baseline=label_shift"],
    "the same, Neural-Sim": [*SCENE, *SENSOR, "baseline=neural_sim"],
}


def overrides_of(options: argparse.Namespace) -> list[str]:
    """Return the overrides that all runs have in common."""
    images = options.shared / "captures" / "flowerpot" / "images"
    return [
        "name=flowerpot", f"scale={options.scale}", f"seed={options.seed}", "objects=photos", "objects/poses=colmap",
        f"objects.root={options.out / 'captures'}", "objects.masks=scene", "objects/beside=ycb",
        f"objects.beside.root={options.shared / 'ycb'}", f"objects.beside.names=[{','.join(OTHERS)}]",
        "target=coco", f"target.annotations={LABELS}", f"target.images={images}", *CAMERA,
        "progress=false", f"paths.store={options.out / 'store'}",
        f"paths.mlflow={options.out / 'mlflow.db'}",
    ]  # fmt: skip


def take_photographs(options: argparse.Namespace) -> None:
    """Link the unlabelled photographs into a separate capture."""
    labelled = {image["file_name"] for image in json.loads(LABELS.read_text())["images"]}
    folder = options.out / "captures" / "flowerpot" / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for photo in (options.shared / "captures" / "flowerpot" / "images").resolve().iterdir():
        if photo.name not in labelled and not (folder / photo.name).exists():
            (folder / photo.name).symlink_to(photo)


def erase(options: argparse.Namespace) -> Path:
    """Write the photographs with the pot erased: its mask is filled with a blurred mean of the surroundings."""
    folder = options.out / "scene"
    folder.mkdir(parents=True, exist_ok=True)
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        context, _ = context_of(compose("config", overrides_of(options)), options.out)
    stage, source = context.graph.views[0], context.experiment.imaging.objects
    assert isinstance(source, Photos) and stage.masks is not None
    pictures = source.pictures(stage.object, context.results(stage.masks))
    for frame in pictures.capture.frames:
        rgba = pictures.rgba(frame)[::2, ::2].numpy()  # half the resolution is enough for a background
        hidden = np.asarray(binary_dilation(rgba[..., 3] > 0.1, iterations=8), dtype=bool)
        filled = np.where(hidden[..., None], 0.0, rgba[..., :3])
        for blur in (6.0, 20.0, 60.0):  # the smallest blur that reaches a pixel fills it
            seen = gaussian_filter((~hidden).astype(np.float32), blur)
            near = np.stack([gaussian_filter(filled[..., c] * ~hidden, blur) for c in range(3)], -1)
            reached = hidden & (seen > 0.02)
            filled[reached] = (near / seen.clip(1e-6)[..., None])[reached]
            hidden &= ~reached
        Image.fromarray((255.0 * filled.clip(0.0, 1.0)).astype(np.uint8)).save(
            folder / f"{frame.image.stem}.jpg"
        )
    return folder


def main() -> None:
    """Run the cases that the command line asks for, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks/flowerpot"))
    parser.add_argument("--scale", default="quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", nargs="*", default=list(RUNS), choices=list(RUNS), metavar="RUN")
    options = parser.parse_args()
    options.out, options.shared = options.out.resolve(), options.shared.resolve()
    take_photographs(options)
    rows = []
    for called in options.runs:
        scene = erase(options) if any("{scene}" in word for word in RUNS[called]) else options.out / "scene"
        own = [word.format(scene=scene) for word in RUNS[called]]
        folder = options.out / "runs" / called.replace(" ", "_").replace(",", "")
        command = [sys.executable, "-m", "src.main", *overrides_of(options), *own, f"hydra.run.dir={folder}"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        found = json.loads((folder / "results.json").read_text())["ap"]
        scores = [100.0 * found[which][kind] for which in ("ns", "learned") for kind in ("ap50", "ap")]
        rows.append([called, *(f"{score:.1f}" for score in scores)])
        print(
            markdown_table(["training images", "AP50 before", "AP", "AP50 after psi", "AP"], rows), flush=True
        )


if __name__ == "__main__":
    main()

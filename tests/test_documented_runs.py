"""Every documented run as it is written, through the command line, at smoke scale, on data made here and on one store:
it ends well and leaves what the documentation promises. Sweeps are cut to their first seed, and scales that take hours
to smoke. Comparisons come last, after the runs that they compare."""

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from documented import ROOT, Command, commands
from documented_data import MadeData
from hydra import compose, initialize_config_dir
from mlflow import MlflowClient

from neural_sim.detector.saved import SavedDetector
from neural_sim.main import conf_directory
from neural_sim.report.tracking import tracking_uri

pytestmark = pytest.mark.slow


def _configuration(job):
    with initialize_config_dir(str(conf_directory()), version_base="1.3"):
        return compose("config", job)


def _compares(command):
    return any(word.startswith("compare.") or word == "+experiment=compare" for word in command.overrides)


def _exports(command):
    return "stages=[export]" in command.overrides


class Runs:
    """Runs commands once each, in folders of their own under one root, with one store and one MLflow."""

    def __init__(self, root):
        self.root, self.data = root, MadeData(root / "data")
        self.folders: dict[Command, object] = {}
        self.numbers = itertools.count()

    def words(self, command):
        """The overrides at smoke scale, with the first of the seeds and made data for paths."""
        written = command.cut(1) if command.multirun else command.overrides
        kept = [self.data.localise(word) for word in written if not word.startswith("scale=")]
        few = ["export.count=3", "export.width=64", "export.height=48"] if _exports(command) else []
        if few:  # into folders of the test's own
            kept = [f"export.folder={self.root / 'exported'}" if "folder=" in word else word for word in kept]
        return [*kept, *few, "scale=smoke"]

    def folder(self, command):
        """Where the command left its files, which it must have done without an error."""
        if command not in self.folders:
            folder = self.root / "runs" / str(next(self.numbers))
            added = [f"paths.store={self.root / 'store'}", f"paths.mlflow={self.root / 'mlflow.db'}"]
            added.append(f"paths.data={self.data.shared}")
            added.append(f"hydra.{'sweep' if command.multirun else 'run'}.dir={folder}")
            run = [sys.executable, "-m", "src.main", *sorted(command.flags), *self.words(command), *added]
            done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, timeout=3000)
            assert done.returncode == 0, (
                f"{command.where}: {' '.join(run)}\n{done.stdout[-1000:]}{done.stderr[-3000:]}"
            )
            self.folders[command] = folder
        return self.folders[command]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return Runs(tmp_path_factory.mktemp("documented"))


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
    if _exports(command):
        _run_what_is_exported(runs, command)
    folder = runs.folder(command)
    folders = [path.parent.parent for path in folder.glob("**/.hydra/config.yaml")]
    assert len(folders) == len(jobs)
    kinds = {"stress": _stress, "compare": _comparison, "interpolation": _interpolation,
             "temperatures": _temperatures, "patch_memory": _patch_memory,
             "nerf_vs_mesh": _nerf_vs_mesh, "sfm_vs_nerf": _sfm_vs_nerf, "samples_gallery": _samples_gallery,
             "detection_gallery": _detection_gallery, "experiments": _experiments}  # fmt: skip
    for job, config in zip(folders, [_of(path) for path in folders], strict=True):
        alone = {"predict": _predict, "export": _export, "preflight": _preflight}.get(config["stages"][0])
        whole = _run if "report" in config["stages"] else _stored
        check = alone or kinds.get(next((key for key in kinds if key in config), ""), whole)
        check(job, config)


def _of(folder):
    from omegaconf import OmegaConf

    return OmegaConf.to_container(OmegaConf.load(folder / ".hydra" / "config.yaml"), resolve=True)


def _run_what_is_compared(runs, experiments):
    for command in ALL:
        if command.multirun and experiments & {_configuration(job).name for job in command.jobs(seeds=1)}:
            runs.folder(command)


def _run_what_is_exported(runs, command):
    """A learned psi is that of the same command without an export."""
    rest = [word for word in command.overrides if not word.startswith(("stages=", "export."))]
    if not any(word.startswith("export.psi=") for word in command.overrides):
        runs.folder(next(other for other in ALL if other.overrides == rest and not other.multirun))


def _export(folder, config):
    """usage.md, Exporting a data set."""
    made = folder / "dataset" if config["export"]["folder"] is None else Path(config["export"]["folder"])
    manifest = json.loads((made / "manifest.json").read_text())
    assert len(manifest["images"]) == 3 and all(
        (made / image["file"]).is_file() for image in manifest["images"]
    )
    assert (made / "psi.csv").is_file() and (made / "psi.json").is_file()
    files = {
        "coco": "annotations.json",
        "yolo": "segment/dataset.yaml",
        "bop": "bop/train/000000/scene_gt.json",
    }
    for name, file in files.items():
        assert (made / file).is_file() == (name in config["export"]["formats"])


def _stored(folder, config):
    """A run without a report: its results are in the store."""
    assert config["stages"] == ["views", "field"] and not (folder / "results.json").exists()
    assert all(list((Path(config["paths"]["store"]) / kind).glob("*")) for kind in ("views", "field"))


def _run(folder, config):
    """README.md, Use: the files of a run."""
    results = json.loads((folder / "results.json").read_text())
    beside = {"synthetic_only", "real_only"} if config["training"]["real"]["mode"] != "none" else set()
    assert set(results["ap"]) == {"ns", "learned", "matched"} | beside
    assert (results["experiment"], results["seed"]) == (config["name"], config["seed"])
    assert {"seconds", "peak_memory_mb", "left_out"} <= set(results)
    for factors in results["psi"].values():
        assert set(config["parameter"]) <= set(factors)  # axis=both has a second of its own
        assert all(set(psi) == {"initial", "learned", "target"} for psi in factors.values())
    if config["baseline"]["name"].startswith("neural_sim"):
        assert len(results["iterations"]) == config["outer"]["iterations"]
    # A method without iterations has no psi over them.
    promised = {
        "ap",
        "training_images",
        "detections",
        *(f"psi_{factor}" for factor in factors if results["iterations"]),
    }
    assert promised <= {path.stem for path in (folder / "figures").glob("*.png")}
    made = json.loads((folder / "training_set" / "annotations.json").read_text())
    assert len(made["images"]) == len(results["psi"]) * config["training"]["images_per_object"]
    assert all((folder / "training_set" / image["file_name"]).is_file() for image in made["images"])
    shown, fewest = (
        [len(image["poses"]) for image in made["images"]],
        config["synthesis"]["objects_per_image"][0],
    )
    assert min(shown) >= fewest and max(shown) > 0

    page = (folder / "report.html").read_text()
    assert "What was learned" in page or not results["iterations"]
    _model(folder, config, list(results["psi"]))


def _model(folder, config, names):
    """README, What a run leaves."""
    assert SavedDetector.load(folder).class_names == tuple(names)
    assert (folder / "model.onnx").exists() == config["model"]["onnx"]
    if config["model"]["registered_name"]:
        client = MlflowClient(tracking_uri(config["paths"]["mlflow"]))
        assert client.search_model_versions(f"name='{config['model']['registered_name']}'")


def _predict(folder, config):
    """README, The detector, and what it sees."""
    images = json.loads((folder / "coco_images.json").read_text())["images"]
    rows = json.loads((folder / "coco_results.json").read_text())
    assert images and rows and {row["image_id"] for row in rows} <= {image["id"] for image in images}
    assert all((folder / "pictures" / image["file_name"]).is_file() for image in images)
    scored = config["predict"]["annotations"] is not None
    assert (folder / "scores.json").exists() == scored


def _preflight(folder, config):
    """usage.md, Before an optimisation."""
    report = json.loads((folder / "preflight.json").read_text())
    assert {one["name"] for one in report["foreseen"]} == set(report["names"])
    bins = config["parameter"]["pose"]["bins"]
    assert all(len(one["by_bin"]) == len(one["by_bin_error"]) == bins for one in report["foreseen"])
    assert report["verdict"] in (folder / "preflight.html").read_text()


def _comparison(folder, config):
    written = json.loads((folder / "compare.json").read_text())
    tables = {table["setting"]: table for table in written["comparisons"]}
    text = (folder / "compare.md").read_text()
    assert set(config["compare"]["experiments"]) <= set(tables)
    for setting, table in tables.items():
        assert table["methods"][0] == config["compare"]["reference"] and len(table["methods"]) > 1
        assert (folder / "figures" / f"{setting.replace(', ', '_')}.png").stat().st_size > 5000
        assert all(f"\n| {method} |" in text for method in table["methods"])
    assert "of the gap closed" in text


def _interpolation(folder, config):
    held = json.loads((folder / "interpolation.json").read_text())
    assert max(held["opacity_change"].values()) <= 1e-6  # float32: the light has no part in it
    assert (folder / "figures" / "interpolation.png").stat().st_size > 5000


def _temperatures(folder, config):
    held = json.loads((folder / "temperatures.json").read_text())
    names, values = config["objects"]["names"], {row["temperature"] for row in held["rows"]}
    assert len(values) > 2 and values == set(config["temperatures"].get("values", values))
    assert [truth["object"] for truth in held["truths"]] == names
    assert len(held["rows"]) == len(names) * len(values) and all(row["images"] > 0 for row in held["rows"])
    # Nearly exact draws lie where p puts them: 0.86 on the first object's dominant bin, 7.
    cold = held["rows"][0]
    assert cold["temperature"] == min(values) and cold["frequencies"][6] > 0.8
    assert (folder / "figures" / "temperatures.png").stat().st_size > 5000


def _patch_memory(folder, config):
    rows = json.loads((folder / "patch_memory.json").read_text())["rows"]
    side = config["camera"].get("width") or config["training"]["image_size"]
    patches = [patch for patch in config["patch_memory"]["patches"] if patch < side**2]
    assert [row["patch"] for row in rows] == [None, *patches, side**2]
    assert all(row["difference"] < 1e-2 for row in rows)  # float32
    assert (folder / "patch_memory.md").stat().st_size > 300


def _nerf_vs_mesh(folder, config):
    held = json.loads((folder / "nerf_vs_mesh.json").read_text())
    other = "blenderproc" if config["nerf_vs_mesh"]["blenderproc"] else "mesh"
    assert held["sources"] == ["nerf", other] and len(held["seeds"]) == config["nerf_vs_mesh"]["seeds"]
    assert set(held["ap"]) == {"single", "multiple"}
    assert all(
        0.0 <= row[source]["value"] <= 1.0 for row in held["ap"].values() for source in held["sources"]
    )
    assert {path.stem for path in (folder / "figures").glob("*.png")} == {"ap", "training_images"}
    poses = json.loads((folder / "training_set" / "annotations.json").read_text())["images"]
    assert poses and all(pose["camera_to_world"] for image in poses for pose in image["poses"])


def _sfm_vs_nerf(folder, config):
    held = json.loads((folder / "sfm_vs_nerf.json").read_text())
    assert held["sources"] == ["nerf", "sfm"] and set(held["ap"]) == {"test"}
    for scores in held["held_out"].values():
        assert all(10.0 < scores[source]["psnr"] < 60.0 for source in held["sources"])
    figures = {path.stem for path in (folder / "figures").glob("*.png")}
    assert figures == {"ap", "training_images", "held_out"}


def _samples_gallery(folder, config):
    held, settings = json.loads((folder / "samples_gallery.json").read_text()), config["samples_gallery"]
    assert set(held) == set(config["parameter"]["pose"]["biased"])
    for each in held.values():
        count = settings.get("count", 18)
        assert set(each["images"].values()) == {count} and 0 < each["test"] <= count
        assert set(each["total_variation"]) == set(settings.get("methods", ("neural_sim", "auto_sim")))
    assert {path.stem for path in (folder / "figures").glob("*.png")} == set(held)


def _detection_gallery(folder, config):
    held = json.loads((folder / "detection_gallery.json").read_text())
    assert list(held["methods"]) == config["detection_gallery"]["methods"] and held["shown"]
    boxes = {each["right"] + each["missed"] for each in held["methods"].values()}
    assert len(boxes) == 1  # every method is judged by the same boxes
    assert (folder / "figures" / "detections.png").stat().st_size > 5000


def _experiments(folder, config):
    text = (folder / "experiments.md").read_text()
    assert all(
        f"| `{row['command']}` |" in text
        for row in json.loads((folder / "experiments.json").read_text())["rows"].values()
    )


def _stress(folder, config):
    held = json.loads((folder / "stress.json").read_text())
    assert held and (folder / "stress.md").stat().st_size > 1000


def test_help_lists_the_keys():
    done = subprocess.run(
        [sys.executable, "-m", "src.main", "--help"], cwd=ROOT, capture_output=True, text=True, timeout=300
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

"""What the documentation promises that a run, a study or a stage leaves in its folder."""

import html
import json
import re
from pathlib import Path

from mlflow import MlflowClient

from neural_sim.detector.saved_detector import SavedDetector
from neural_sim.report.tracking import tracking_uri


def check_of(config):
    """The check of a configuration, which takes the folder and the configuration."""
    stages = {
        "predict": _predict,
        "export": _export,
        "preflight": _preflight,
        "repeat": _repeat,
        "sample": _sample,
        "viewer": _viewer,
    }
    alone = stages.get(config["stages"][-1])
    whole = _run if "report" in config["stages"] else _stored
    return alone or KINDS.get(next((key for key in KINDS if key in config), ""), whole)


def _export(folder, config):
    """use.md, Export a data set."""
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
    real = config["training"]["real"]
    beside = (
        {"synthetic_only", "real_only", "views_only"}
        if real["mode"] != "none" and real["count"] != 0
        else set()
    )
    photographs = config["target"]["_target_"].rpartition(".")[2] != "RenderedTarget"
    stated = any(
        own.get("target", "uniform") != "uniform"
        for factor in config["parameter"].values()
        for own in (factor["biased"] or {}).values()
    )
    known = not photographs or stated
    assert set(results["ap"]) == {"ns", "learned", *(["matched"] if known else [])} | beside
    assert (results["experiment"], results["seed"]) == (config["name"], config["seed"])
    assert {"seconds", "peak_memory_mb", "left_out"} <= set(results)
    for factors in results["psi"].values():
        assert set(config["parameter"]) <= set(factors)  # axis=both has a second of its own
        assert all(
            set(psi) == {"initial", "learned", *(["target"] if known else [])} for psi in factors.values()
        )
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
    """README.md, Use: the files of a run."""
    assert SavedDetector.load(folder).class_names == tuple(names)
    assert (folder / "model.onnx").exists() == config["model"]["onnx"]
    if config["model"]["registered_name"]:
        client = MlflowClient(tracking_uri(config["paths"]["mlflow"]))
        assert client.search_model_versions(f"name='{config['model']['registered_name']}'")


def _predict(folder, config):
    """use.md, Detect in photographs."""
    images = json.loads((folder / "coco_images.json").read_text())["images"]
    rows = json.loads((folder / "coco_results.json").read_text())
    assert images and rows and {row["image_id"] for row in rows} <= {image["id"] for image in images}
    assert all((folder / "pictures" / image["file_name"]).is_file() for image in images)
    scored = config["predict"]["annotations"] is not None
    assert (folder / "scores.json").exists() == scored


def _preflight(folder, config):
    """reading.md, Before an optimisation."""
    report = json.loads((folder / "preflight.json").read_text())
    assert {one["name"] for one in report["foreseen"]} == set(report["names"])
    bins = config["parameter"]["pose"]["bins"]
    assert all(len(one["by_bin"]) == len(one["by_bin_error"]) == bins for one in report["foreseen"])
    page = html.unescape((folder / "preflight.html").read_text())
    assert report["verdict"] in page and report["worth"] in page
    counts = {gain["photographs"] for gain in report["labelled"]}
    assert bool(counts) == bool(config["target"].get("train_fraction"))


def _repeat(folder, config):
    """reading.md, The report."""
    written = json.loads((folder / "repeat.json").read_text())
    biased, everything, *each = written["groups"]
    assert set(biased["names"]) == set(config["parameter"]["pose"]["biased"]) < set(everything["names"])
    assert [[name] for name in everything["names"]] == [group["names"] for group in each]
    for group in written["groups"]:
        assert set(group["scores"]) == {"ns", "learned", "matched"} and group["over_images"] >= 0.0
        assert all(len(scores) == config["repeat"]["trainings"] for scores in group["scores"].values())
    assert len({tuple(group["scores"]["ns"]) for group in each}) > 1 and everything["between"] > 0.0
    text = (folder / "repeat.md").read_text()
    assert "trainings of each distribution" in text and all(
        f"| {name} |" in text for name in everything["names"]
    )


def _sample(folder, config):
    """tutorial.md: what it needs."""
    made = Path(config["sample"]["folder"])
    assert {path.name for path in (made / "captures").iterdir()} == set(config["objects"]["names"])
    assert json.loads((made / "labels.json").read_text())["annotations"] and any((made / "new").iterdir())


def _viewer(folder, config):
    """reading.md, The viewer; what the page shows is checked in tests/report/test_viewer.py."""
    assert config["viewer"]["seconds"] == 1 and config["viewer"]["psi"] in ("initial", "learned")


def _comparison(folder, config):
    """Other documented runs of these experiments, which are scored in other ways, have tables of their own."""
    written = json.loads((folder / "compare.json").read_text())
    tables = {table["setting"]: table for table in written["comparisons"]}
    text = (folder / "compare.md").read_text()
    compared = {setting.partition(",")[0] for setting, table in tables.items() if len(table["methods"]) > 1}
    assert set(config["compare"]["experiments"]) <= compared
    for setting, table in tables.items():
        assert table["methods"][0] == config["compare"]["reference"]
        assert (folder / "figures" / f"{re.sub('[, ]+', '_', setting)}.png").stat().st_size > 5000
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


def _work_precision(folder, config):
    """methods.md, Studies."""
    held = json.loads((folder / "work_precision.json").read_text())
    families = {name.split("/")[0] for name in held["measured"]}
    assert families == set(config["work_precision"]["families"])
    wanted = {"name", "setting", "error", "error_kind", "seconds", "memory_mb", "default", "pareto"}
    assert all(wanted <= set(row) for row in held["series"])
    for name in held["measured"]:
        assert any(row["pareto"] for row in held["series"] if row["name"] == name)
    assert len(list((folder / "figures").glob("*.png"))) == len(held["measured"])
    if "quadrature" in families:
        smooth = {o["line"]: o for o in held["orders"] if o["name"] == "quadrature/smooth, opacity"}
        assert (
            abs(smooth["midpoint"]["observed"] - 2.0) < 0.1
            and abs(smooth["jittered"]["observed"] - 1.5) < 0.3
        )
    assert (folder / "work_precision.md").stat().st_size > 1000


KINDS = {"work_precision": _work_precision, "stress": _stress, "compare": _comparison, "interpolation": _interpolation,
             "temperatures": _temperatures, "patch_memory": _patch_memory,
             "nerf_vs_mesh": _nerf_vs_mesh, "sfm_vs_nerf": _sfm_vs_nerf, "samples_gallery": _samples_gallery,
             "detection_gallery": _detection_gallery, "experiments": _experiments}  # fmt: skip
"""Checks of studies, by the key of their stage."""

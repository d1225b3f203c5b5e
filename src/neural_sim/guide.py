"""The commands of ``neural-sim``, which are short for settings of the configuration, and the text of ``--help``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import neural_sim
from neural_sim.commandline import Layout


@dataclass(frozen=True)
class Verb:
    """A command.

    Attributes:
        says: what it does.
        words: the settings that it stands for.
        keys: the keys that its help shows, with their comments in ``conf/``.
        example: words that follow it in an example.
    """

    says: str
    words: tuple[str, ...]
    keys: tuple[str, ...]
    example: str = ""


VERBS = {
    "demo": Verb(
        "learn which poses of the embedded objects to render; takes minutes on two cores",
        ("+experiment=pose_gap",),
        ("scale", "seed", "baseline", "gap", "outer.iterations"),
        "scale=smoke",
    ),
    "field": Verb(
        "fit a radiance field to each object, and show how good it is (objects.html)",
        ("stages=[views,field]",),
        (
            "objects",
            "objects.root",
            "objects.names",
            "objects.masks",
            "objects.box",
            "objects.poor",
            "field",
            "views.count",
        ),
        "objects=photos objects.root=/data/captures",
    ),
    "check": Verb(
        "estimate whether an optimisation is worth running (preflight.html)",
        ("stages=[preflight]",),
        ("objects", "target", "target.annotations", "parameter", "preflight.trials", "preflight.moved"),
        "objects=photos objects.root=/data/captures target=coco target.annotations=/data/val.json",
    ),
    "learn": Verb(
        "learn what to render, train detectors on it, and score them (report.html)",
        (),
        (
            "objects",
            "target",
            "target.annotations",
            "target.split_by",
            "parameter",
            "baseline",
            "detector",
            "scale",
            "seed",
        ),
        "objects=photos objects.root=/data/captures target=coco target.annotations=/data/val.json",
    ),
    "score": Verb(
        "train and score detectors on the learned distribution, without the report",
        ("stages=[evaluate]",),
        ("detector", "training.cold_epochs", "training.images_per_object", "seed"),
        "+experiment=pose_gap",
    ),
    "export": Verb(
        "write a data set of annotated images: COCO, YOLO or BOP",
        ("stages=[export]",),
        (
            "export.count",
            "export.psi",
            "export.width",
            "export.height",
            "export.formats",
            "export.folder",
            "export.detail",
        ),
        "+experiment=pose_gap export.count=300 export.psi=initial",
    ),
    "predict": Verb(
        "detect objects in photographs with a trained model, and score it if they are labelled",
        ("stages=[predict]",),
        (
            "predict.model",
            "predict.images",
            "predict.annotations",
            "predict.categories",
            "predict.draw_above",
        ),
        "predict.model=outputs/runs/shelf/2026-11-22_09-00-00 predict.images=/data/shelf/new",
    ),
    "view": Verb(
        "open a page with the fields, the cameras of every bin, and renders with detections",
        ("stages=[viewer]",),
        ("viewer.psi", "viewer.port", "viewer.seconds"),
        "+experiment=pose_gap",
    ),
    "box": Verb(
        "set the box around a photographed object by hand, if computed masks miss it",
        ("stages=[box]", "objects=photos"),
        ("objects.root", "box.object", "box.port", "box.seconds"),
        "objects.root=/data/captures objects/poses=colmap",
    ),
    "compare": Verb(
        "compare the finished runs of an experiment",
        ("+experiment=compare",),
        ("compare.experiments", "compare.clock", "paths.mlflow"),
        "'compare.experiments=[pose_gap]'",
    ),
    "sample": Verb(
        "write data to try the commands with: captures, meshes and labelled pictures",
        ("+experiment=sample_data",),
        ("sample.folder", "objects.names", "views.count", "target.val_per_object", "seed"),
    ),
    "doctor": Verb(
        "check packages, device, memory, OpenGL, the store's results, MLflow and data",
        ("stages=[doctor]",),
        ("paths.store", "paths.mlflow", "paths.data", "doctor.memory_gb", "doctor.disk_gb"),
    ),
}


def spoken(words: Sequence[str]) -> list[str]:
    """Replace a command at the beginning by the words that it stands for."""
    if words and words[0] in VERBS:
        return [*VERBS[words[0]].words, *words[1:]]
    return list(words)


def answer(words: Sequence[str], layout: Layout) -> str | None:
    """Answer ``--version``, ``--help`` or ``help``, ``COMMAND --help`` and ``--help keys``; None for other words."""
    if "--version" in words:
        return f"neural-sim {neural_sim.__version__}"
    if not {"--help", "-h"} & set(words) and words[:1] != ["help"]:
        return None
    named = [word for word in words[:2] if word in VERBS]
    if named:
        return _help_of(named[0], layout)
    return _all_keys(layout) if words[-1] == "keys" else _help(layout)


def _help(layout: Layout) -> str:
    embedded = [name for name in layout.groups["experiment"] if not _brings_data(name, layout)]
    others = [name for name in layout.groups["experiment"] if name not in embedded]
    lines = [
        "Learn which synthetic images to render, so that a detector trained on them does best on a target.",
        "",
        "    neural-sim [COMMAND] [KEY=VALUE ...]        in a checkout also: python -m src.main [COMMAND] ...",
        "",
        "Commands (COMMAND --help: its keys)",
        *(f"    {name:9} {verb.says}" for name, verb in VERBS.items()),
        "",
        "Experiments (+experiment=NAME; docs/experiments.md)",
        *_wrapped("without data of your own: ", embedded),
        *_wrapped("with other data: ", others),
        "",
        "Choices (GROUP=CHOICE; the first is the default)",
        *(_choices(group, layout) for group in layout.defaults),
        "",
        "Keys: --help keys. Sweeps: -m seed=0,1,2. Words with brackets, braces or spaces need quotes in most shells.",
        'Shell completion: eval "$(neural-sim -sc install=bash)"',
    ]
    return "\n".join(lines)


def _brings_data(experiment: str, layout: Layout) -> bool:
    files = (folder / "experiment" / f"{experiment}.yaml" for folder in layout.folders)
    return any("ycb" in path.read_text(encoding="utf-8") for path in files if path.is_file())


def _wrapped(head: str, names: Sequence[str]) -> list[str]:
    return textwrap.wrap(head + ", ".join(names), 118, initial_indent="    ", subsequent_indent="      ")


def _choices(group: str, layout: Layout) -> str:
    default = layout.defaults[group].value
    others = [choice for choice in layout.groups[group] if choice != default]
    return f"    {group:17} {' | '.join([default, *others])}"


def _help_of(name: str, layout: Layout) -> str:
    verb = VERBS[name]
    lines = [
        f"neural-sim {name}: {verb.says}.",
        "",
        "    neural-sim " + " ".join(filter(None, (name, verb.example))),
        "",
    ]
    if verb.words:
        lines += [f"It stands for {' '.join(verb.words)}. Some keys (--help keys has all):", ""]
    else:
        lines += ["Some keys (--help keys has all):", ""]
    return "\n".join([*lines, *(_line(key, layout) for key in verb.keys)])


def _line(key: str, layout: Layout) -> str:
    if key in layout.defaults:
        value, comment = layout.defaults[key].value, " | ".join(layout.groups[key])
    else:
        at = layout.keys[key]
        chosen = next((one for one in at if one.comment), at[0])
        value, comment = chosen.value, chosen.comment
    return f"    {key}={value}" + (f"\n        {comment}" if comment else "")


def _all_keys(layout: Layout) -> str:
    """Return the text of config.yaml, followed by that of the default choices."""
    base = (layout.folders[0] / "config.yaml").read_text(encoding="utf-8").partition("\nhydra:")[0]
    parts = [base]
    for group, default in layout.defaults.items():
        text = (layout.folders[0] / group / f"{default.value}.yaml").read_text(encoding="utf-8")
        package = "" if "# @package _global_" in text else f"{group.replace('/', '.')}:\n"
        parts.append(f"# {group}={default.value}\n{package}" + textwrap.indent(text, "  " if package else ""))
    return "\n\n".join(part.strip("\n") for part in parts)

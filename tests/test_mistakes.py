"""Typical mistakes of a beginner: each is one line that says what to type instead, and leaves nothing behind."""

import logging
import sys

import pytest

from neural_sim import main as program

MISTAKES = [  # what is typed, where {here} is a folder with an empty one, and what the line must say
    ("dmeo", "dmeo: no such command or experiment; did you mean demo?"),
    ("pose_gap", "pose_gap: want +experiment=pose_gap"),
    ("+experiment=pose_gab", "did you mean experiment=pose_gap"),
    ("experiment=pose_gap", "want +experiment=pose_gap, because it has no default"),
    ("detecter=fcos", "detecter: unknown key; did you mean detector"),
    ("detector=yolo", "detector=yolo: no such choice; want one of classifier, "),
    ("scale=big", "want one of paper, quick, smoke"),
    ("seed 1", "seed: want key=value, such as seed=1"),
    ("-m seed=0 1 2", "1: want key=value; values of a sweep are joined by commas, such as -m seed=0,1,2"),
    ("iterations=3", "did you mean outer.iterations"),
    ("stages=[train]", "no stage train; want some of views, field, target_sets, warm_start, psi, evaluate, report, "),
    ("stages=[fields,psi]", "no stage fields; did you mean field?"),
    ("stages=[export", "check its brackets and quotes"),
    ("objects=photos objects.root={here}/mugs", "mugs does not exist; want a folder that holds a folder for"),
    ("objects.root={here}", "want objects=bop or objects=co3d or objects=folder or objects=photos or objects=ycb"),
    ("target=coco target.annotations={here}/val.json", "val.json does not exist; want a COCO file of labelled"),
    ("predict predict.model={here}/run", "run does not exist; want a run's folder, such as outputs/runs/"),
    ("predict predict.images={here}/photos", "photos does not exist; want a picture, a folder or a pattern"),
    ("seed=one", "seed: want a whole number, got 'one'"),
    ("objects=photos", "objects.root is not given: want a folder that holds a folder for each object, "),
    ("outer.iterations=0", "outer.iterations: want at least 1, got 0"),
    ("export export.width=640", "export.width: want width and height or neither, got 640 and None"),
    ("--scale smoke", "--scale smoke: want scale=smoke, without dashes"),
    ("demo --scale=smoke", "--scale=smoke: want scale=smoke, without dashes"),
    ("demo --smoke", "--smoke: no such flag; want scale=smoke"),
    ("demo -seed=1", "-seed=1: want seed=1, without dashes"),
    ("demo --verbose", "--verbose: no such flag; want key=value, such as seed=1, or --help"),
    ("stages=views,field", "stages=views,field: want a list, in quotes: 'stages=[views,field]'"),
    ("stages=[views, field]", "stages=[views, field]: spaces end a setting; want quotes about it: 'stages=[views, "),
    ("objects=photos objects.root=my photos", "want quotes about it: 'objects.root=my photos'"),
    ("field {here}", "want objects=photos objects.root={here}, or objects=folder for meshes"),
    ("scale = smoke", "scale =: want scale=..., without spaces"),
    ("demo seed=0,1,2", "want -m seed=0,1,2 for a run of each value, or 'seed=[0,1,2]' for a list"),
    ("experiment pose_gap", "experiment: want +experiment= and one of"),
    ("demo device=cuda", "device: unknown key; want trainer=gpu or trainer=cpu"),
    ("demo output=here", "output: unknown key; want hydra.run.dir=FOLDER"),
    ("demo smoke", "smoke: want scale=smoke"),
    ("learnn", "learnn: no such command or experiment; did you mean learn?"),
    ("viewer", "viewer: no such command or experiment; did you mean view?"),
    ("objekts=photos", "objekts: unknown key; did you mean objects?"),
    ("objects=photo", "objects=photo: no such choice; did you mean objects=photos?"),
    ("predict", "predict.images: want a picture, a folder or a pattern in quotes, got None"),
]  # fmt: skip


@pytest.mark.parametrize(("typed", "said"), MISTAKES)
def test_a_mistake_is_one_line_that_says_what_to_type(typed, said, tmp_path, monkeypatch, capsys):
    """In this process, so that it is soon told; test_commandline.py has what a new one takes."""
    monkeypatch.setattr(logging, "raiseExceptions", True)  # which the program sets
    here = tmp_path / "empty"
    here.mkdir()
    (here / "my photos").mkdir()
    monkeypatch.chdir(here)
    words = [word.format(here=here) for word in typed.split()]
    places = [f"paths.store={here}/store", f"paths.mlflow={here}/mlflow.db", "hydra/job_logging=none"]
    monkeypatch.setattr(sys, "argv", ["neural-sim", *words, *places])
    with pytest.raises(SystemExit) as ended:
        program.main()
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.out == ""
    assert (
        told.err.startswith("neural-sim: ")
        and told.err.count("\n") == 1
        and said.format(here=here) in told.err
    )
    assert list(here.iterdir()) == [here / "my photos"]

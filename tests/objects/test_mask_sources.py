"""Masks that other programs write: images of labels by the object's value, and a command of the user's."""

import shlex
import sys

import numpy as np
import pytest
import torch
from captures import capture
from PIL import Image

from neural_sim.masks import read_mask
from neural_sim.objects.mask_command import MaskCommand
from neural_sim.objects.photos import Photos

BRIGHT = """
import sys
from pathlib import Path
from PIL import Image
given, made = Path(sys.argv[1]), Path(sys.argv[2])
for path in sorted(given.iterdir()):
    picture = Image.open(path).convert("L")
    picture.point(lambda value: 255 * (value > 100)).save(made / f"{path.stem}_mask.png")
"""


def program(folder, text):
    path = folder / "masks.py"
    path.write_text(text)
    return f"{shlex.quote(sys.executable)} {shlex.quote(str(path))} {{images}} {{masks}}"


@pytest.fixture
def photographs(tmp_path):
    paths = []
    for number in range(3):
        pixels = np.zeros((12, 16, 3), np.uint8)
        pixels[2 : 8 + number, 4:9] = 200
        paths.append(tmp_path / f"photo {number}.png")
        Image.fromarray(pixels).save(paths[-1])
    return paths


@pytest.mark.parametrize("mode", ["L", "P", "I;16"])
def test_of_labels_the_objects_value_counts(tmp_path, mode):
    labels = np.zeros((6, 8), np.uint8)
    labels[1:3], labels[3:5], labels[5] = 1, 2, 7
    picture = Image.fromarray(labels.astype(np.uint16) if mode == "I;16" else labels)
    if mode == "P":
        picture = Image.fromarray(labels, "P")
        picture.putpalette([*range(3), 200, 0, 0, 0, 200, 0, *range(15), 9, 9, 9])
    path = tmp_path / "labels.png"
    picture.save(path)
    assert np.array_equal(read_mask(path, 2), labels == 2)
    with pytest.raises(ValueError, match=r"holds 4 labels; .*set objects\.mask_value"):
        read_mask(path)


def test_a_value_wants_one_channel(tmp_path):
    path = tmp_path / "colours.png"
    Image.new("RGB", (8, 6)).save(path)
    with pytest.raises(ValueError, match=r"want labels in one channel for objects\.mask_value=3, got RGB"):
        read_mask(path, 3)


def test_captures_read_labels_by_the_objects_value(tmp_path):
    made = capture(tmp_path, count=4, width=80, height=60)
    for path in (made.folder / "masks").iterdir():
        alpha = np.asarray(Image.open(path))
        labels = np.where(alpha > 127, 5, np.arange(alpha.shape[1])[None] % 3)
        Image.fromarray(labels.astype(np.uint8)).save(path)
    photos = Photos(tmp_path, mask_value={"can": 5})
    frame = photos.captures["can"].frames[0]
    mask = photos.pictures("can").rgba(frame)[..., 3]
    labels = np.asarray(Image.open(made.folder / "masks" / "000.png"))
    assert np.array_equal(mask.numpy() == 1.0, labels == 5) and set(mask.unique().tolist()) == {0.0, 1.0}
    other = Photos(tmp_path, mask_value=4)
    assert other.digests() != photos.digests()


def test_a_command_makes_a_mask_of_each_photograph(tmp_path, photographs):
    masks = MaskCommand(program(tmp_path, BRIGHT)).masks(photographs)
    for number, mask in enumerate(masks):
        want = torch.zeros(12, 16)
        want[2 : 8 + number, 4:9] = 1.0
        assert torch.equal(mask, want)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise SystemExit('no model')", r"ended with status 1: no model"),
        (BRIGHT.replace("sorted(given.iterdir())", "sorted(given.iterdir())[1:]"),
         r"wrote 0 masks named 00000\*, want one, for .*photo 0\.png; it wrote 2 pictures"),
        (BRIGHT.replace('convert("L")', 'convert("L").resize((8, 6))'),
         r"the mask has 8 x 6 pixels, but its image .*photo 0\.png has 16 x 12"),
    ],
)  # fmt: skip
def test_what_a_command_fails_at_is_said(tmp_path, photographs, text, message):
    with pytest.raises(ValueError, match=message) as error:
        MaskCommand(program(tmp_path, text)).masks(photographs)
    assert "\n" not in str(error.value)


def test_a_command_that_cannot_be_run_is_named(tmp_path, photographs):
    path = tmp_path / "no_shebang"
    path.write_text("echo\n")
    path.chmod(0o755)
    with pytest.raises(ValueError, match=r"objects\.mask_command: .*no_shebang cannot be run: Exec format"):
        MaskCommand(f"{shlex.quote(str(path))} {{images}} {{masks}}").masks(photographs)


def test_captures_take_their_masks_from_a_command(tmp_path):
    made = capture(tmp_path, count=4, width=80, height=60)
    (made.folder / "masks").rename(made.folder / "elsewhere")
    photos = Photos(tmp_path, masks="command", mask_command=program(tmp_path, BRIGHT))
    frame = photos.captures["can"].frames[2]
    grey = np.asarray(Image.open(frame.image).convert("L"))
    assert np.array_equal(photos.pictures("can").rgba(frame)[..., 3].numpy(), (grey > 100).astype(np.float32))

"""The reader of pictures and masks: what cameras, scanners and other programs leave in files, by small made ones."""

import io
import logging
import struct
import zlib

import numpy as np
import pytest
from PIL import Image, ImageOps, PngImagePlugin

from neural_sim.masks import read_mask
from neural_sim.pictures import (
    alpha_of,
    check_headers,
    eight_bits,
    picture_files,
    read_grid,
    read_header,
    read_picture,
)  # fmt: skip

RANDOM = np.random.default_rng(0)
PIXELS = RANDOM.integers(0, 255, (6, 8, 3), np.uint8)
RAMP = np.linspace(0, 1, 48).reshape(6, 8)


def saved(path, picture, **more):
    picture.save(path, **more)
    return path


def exif(orientation):
    made = Image.Exif()
    made[0x0112] = orientation
    return made


def pixels(path, **more):
    return np.asarray(read_picture(path, **more))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "webp", "tif"])
def test_plain_pictures_are_what_pillow_reads(tmp_path, suffix):
    path = saved(tmp_path / f"a.{suffix}", Image.fromarray(PIXELS))
    with Image.open(path) as image:
        assert np.array_equal(pixels(path), np.asarray(image.convert("RGB")))
    assert read_header(path).shown == (8, 6) and read_header(path).turning == ""


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns_every_format_as_pillow_does(tmp_path, suffix, orientation):
    path = saved(tmp_path / f"a.{suffix}", Image.fromarray(PIXELS), exif=exif(orientation))
    with Image.open(path) as image:
        turned = ImageOps.exif_transpose(image).convert("RGB")
    assert np.array_equal(pixels(path), np.asarray(turned))
    assert read_header(path).shown == turned.size
    if suffix != "tif" and orientation > 1:  # Pillow turns TIFF by itself
        assert pixels(path, upright=False).shape == (6, 8, 3)
        assert f"its EXIF orientation {orientation} shows the stored 8 x 6" in read_header(path).turning


@pytest.mark.parametrize("held", [b"Exif\0\0garbage", b"Exif\0\0II*\0\x08\0\0\0\xff\xff", b""])
def test_damaged_exif_says_nothing(tmp_path, held):
    path = saved(tmp_path / "a.jpg", Image.fromarray(PIXELS), exif=held)
    assert pixels(path).shape == (6, 8, 3)
    nine = saved(tmp_path / "b.jpg", Image.fromarray(PIXELS), exif=exif(9))
    assert read_header(nine).orientation == 1


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_grey_of_sixteen_bits_is_scaled(tmp_path, suffix):
    path = saved(tmp_path / f"a.{suffix}", Image.fromarray((RAMP * 65535).astype(np.uint16)))
    assert np.abs(pixels(path)[..., 0].astype(float) - 255 * RAMP).max() <= 0.51
    big = saved(tmp_path / "b.pgm", Image.fromarray((RAMP * 65535).astype(np.int32)))
    assert np.array_equal(pixels(big), pixels(path))


def test_floats_are_scaled_or_refused_by_their_values(tmp_path):
    path = saved(tmp_path / "a.tif", Image.fromarray(RAMP.astype(np.float32)))
    assert np.abs(pixels(path)[..., 0].astype(float) - 255 * RAMP).max() <= 0.51
    for values, said in ((2 * RAMP, "0 to 2"), (-RAMP, "-1 to -?0"), (RAMP * np.nan, "nan to nan")):
        saved(path, Image.fromarray(values.astype(np.float32)))
        with pytest.raises(ValueError, match=rf"a\.tif: .*mode F want values from 0 to 1, got {said}"):
            read_picture(path)


@pytest.mark.parametrize(("mode", "said"), [("I", r"32-bit integers \(mode I\)"), ("LAB", "mode LAB")])
def test_modes_without_a_known_white_are_refused_by_their_headers(tmp_path, mode, said):
    path = saved(tmp_path / "a.tif", Image.new(mode, (8, 6)))
    for read in (read_picture, lambda path: check_headers([path], "key")):
        with pytest.raises(ValueError, match=rf"a\.tif: .*{said}"):
            read(path)


def test_palettes_cmyk_grey_and_bits_become_rgb(tmp_path):
    palette = Image.fromarray(PIXELS).quantize(8)
    for name, made in {
        "p.png": palette,
        "k.jpg": Image.fromarray(PIXELS).convert("CMYK"),
        "l.png": Image.fromarray(PIXELS[..., 0]),
        "1.png": Image.fromarray(PIXELS[..., 0] > 99),
        "y.jpg": Image.fromarray(PIXELS).convert("YCbCr"),
    }.items():
        path = saved(tmp_path / name, made)
        with Image.open(path) as image:
            assert np.array_equal(pixels(path), np.asarray(image.convert("RGB")))


def test_transparency_of_palettes_colours_and_sixteen_bits_is_alpha(tmp_path):
    index = np.zeros((6, 8), np.uint8)
    index[2:4, 2:5] = 1
    palette = Image.fromarray(index, "P")
    palette.putpalette([9, 9, 9, 200, 0, 0])
    grey = Image.fromarray(np.where(index, 40000, 7).astype(np.uint16))
    colour = Image.fromarray(np.where(index[..., None], [200, 0, 0], [9, 9, 9]).astype(np.uint8))
    for name, made, clear in (("p", palette, 0), ("i", grey, 7), ("c", colour, (9, 9, 9))):
        path = saved(tmp_path / f"{name}.png", made, transparency=clear)
        assert read_header(path).transparent, name
        alpha = alpha_of(read_picture(path))
        assert alpha is not None and np.array_equal(np.asarray(alpha) > 0, index > 0), name
        assert np.array_equal(read_mask(path), index), name


def test_an_alpha_channel_that_is_opaque_everywhere_is_none(tmp_path):
    for mode in ("RGBA", "LA"):
        path = saved(tmp_path / "a.png", Image.fromarray(PIXELS).convert("L").convert(mode))
        assert alpha_of(read_picture(path)) is None
    assert alpha_of(Image.fromarray(PIXELS)) is None


def test_pixels_in_memory_are_scaled_too():
    made = eight_bits(Image.fromarray((RAMP * 65535).astype(np.uint16)))
    assert made.mode == "RGB" and made.getextrema() == ((0, 255),) * 3


# --- what cannot be read ---


def refused(path, reason=""):
    with pytest.raises(ValueError, match=rf"{path.name}: not a readable image \(.*{reason}") as error:
        read_picture(path)
    assert "\n" not in str(error.value)


def test_files_that_are_missing_folders_or_no_pictures_are_named(tmp_path):
    refused(tmp_path / "missing.png", "No such file")
    (tmp_path / "folder.png").mkdir()
    refused(tmp_path / "folder.png")
    for name, held in (("empty.png", b""), ("text.jpg", b"<html>not found</html>"), ("zeros.tif", bytes(99))):
        (tmp_path / name).write_bytes(held)
        refused(tmp_path / name)


def test_sizes_above_pillows_limit_are_named(tmp_path):
    path = saved(tmp_path / "large.png", Image.new("1", (15000, 13000)))
    refused(path, "exceeds limit")
    with pytest.raises(ValueError, match=r"key: .*large\.png: .*exceeds limit"):
        check_headers([path], "key")


def test_large_metadata_is_named(tmp_path):
    info = PngImagePlugin.PngInfo()
    info.add_text("Comment", "x" * 3_000_000, zip=True)
    refused(saved(tmp_path / "comment.png", Image.fromarray(PIXELS), pnginfo=info), "too large")
    # Pillow reads such a profile by leaving it out, or refuses it: either is right, but never without the name.
    profile = saved(tmp_path / "profile.png", Image.fromarray(PIXELS), icc_profile=b"p" * 3_000_000)
    try:
        assert np.array_equal(pixels(profile), PIXELS)
    except ValueError as error:
        assert "profile.png: not a readable image" in str(error)


def test_a_file_that_ends_early_is_named(tmp_path):
    path = saved(tmp_path / "a.png", Image.fromarray(RANDOM.integers(0, 255, (60, 80), np.uint8)))
    path.write_bytes(path.read_bytes()[:2000])
    assert read_header(path).stored == (80, 60)
    refused(path)
    with pytest.raises(ValueError, match=r"a\.png: not a readable image"):
        read_grid(path, (80, 60))
    with pytest.raises(ValueError, match=r"a\.png: not a readable image"):
        read_mask(path)


def test_no_damage_raises_anything_but_a_line_with_the_file(tmp_path):
    """Cut off, with flipped bits, with chunks whose lengths lie."""
    random = np.random.default_rng(1)
    sources = {}
    for suffix, mode in (
        ("png", "RGB"),
        ("png", "P"),
        ("jpg", "RGB"),
        ("tif", "RGB"),
        ("webp", "RGBA"),
        ("bmp", "L"),
    ):
        made = io.BytesIO()
        picture = Image.fromarray(random.integers(0, 255, (20, 30, 3), np.uint8)).convert(mode)
        picture.save(made, {"jpg": "JPEG", "tif": "TIFF"}.get(suffix, suffix.upper()), exif=exif(6))
        sources[f"{mode}.{suffix}"] = made.getvalue()
    read = 0
    for name, whole in sources.items():
        for trial in range(60):
            held = bytearray(whole[: int(random.integers(1, len(whole)))] if trial % 3 == 0 else whole)
            for place in random.integers(0, min(len(held), 99 if trial % 3 == 1 else len(held)), 4):
                held[place] ^= 1 << int(random.integers(8))
            path = tmp_path / name
            path.write_bytes(held)
            for reader in (read_picture, read_mask, read_grid, read_header):
                try:
                    reader(path)
                    read += 1
                except ValueError as error:
                    assert name in str(error) and "\n" not in str(error)
    assert read


def test_a_lying_chunk_is_named(tmp_path):
    path = saved(tmp_path / "a.png", Image.fromarray(PIXELS))
    held = path.read_bytes()
    head = struct.pack(">II", 0, 6) + held[24:29]
    path.write_bytes(held[:16] + head + struct.pack(">I", zlib.crc32(b"IHDR" + head)) + held[33:])
    refused(path)


# --- leftovers ---


def test_leftovers_of_other_programs_are_left_out_with_a_count(tmp_path, caplog):
    kept = tmp_path / "more"
    for folder in (kept, tmp_path / "__MACOSX" / "more", tmp_path / "@eaDir" / "a.jpg"):
        folder.mkdir(parents=True)
        saved(folder / "a.jpg", Image.fromarray(PIXELS))
    (kept / "._a.jpg").write_bytes(b"\x00\x05\x16\x07" + bytes(99))
    with caplog.at_level(logging.WARNING):
        assert picture_files(tmp_path) == [kept / "a.jpg"]
        assert picture_files(tmp_path) == [kept / "a.jpg"]
    assert caplog.text.count("3 leftovers of other programs are left out, such as") == 1
    inside = tmp_path / "__MACOSX"
    assert picture_files(inside) == [inside / "more" / "a.jpg"]  # asked for by name


# --- masks and grids ---

DISC = np.hypot(*(np.mgrid[:20, :30] - np.array([[[9.5]], [[14.5]]]))) < 7


@pytest.mark.parametrize("values", [(0, 255), (0, 1), (0, 128), (3, 200), (254, 255)])
def test_two_values_of_grey_are_background_and_object(tmp_path, values):
    path = saved(tmp_path / "m.png", Image.fromarray(np.where(DISC, values[1], values[0]).astype(np.uint8)))
    assert np.array_equal(read_mask(path), DISC)
    wide = np.where(DISC, 90 * values[1], 90 * values[0]).astype(np.uint16)
    assert np.array_equal(read_mask(saved(path, Image.fromarray(wide))), DISC)


def test_opacities_of_grey_stay(tmp_path):
    soft = (255 * RAMP).astype(np.uint8)
    assert np.array_equal(
        read_mask(saved(tmp_path / "m.png", Image.fromarray(soft))), np.float32(soft) / np.float32(255)
    )
    wide = (65535 * RAMP).astype(np.uint16)
    made = read_mask(saved(tmp_path / "m.png", Image.fromarray(wide)))
    assert np.allclose(made, RAMP, atol=2e-5)
    lossy = saved(tmp_path / "m.jpg", Image.fromarray((255 * DISC).astype(np.uint8)))
    assert np.array_equal(read_mask(lossy) > 0.5, DISC)


def test_black_and_white_in_other_modes(tmp_path):
    bits, grey = Image.fromarray(DISC), Image.fromarray((255 * DISC).astype(np.uint8))
    white_first = Image.fromarray((~DISC).astype(np.uint8), "P")
    white_first.putpalette([255, 255, 255, 0, 0, 0])
    floats = Image.fromarray(DISC.astype(np.float32))
    for name, made in (
        ("1.png", bits), ("rgb.png", grey.convert("RGB")), ("rgba.png", grey.convert("RGBA")),
        ("la.png", grey.convert("LA")), ("p.png", white_first), ("f.tif", floats),
    ):  # fmt: skip
        assert np.array_equal(read_mask(saved(tmp_path / name, made)), DISC), name


def test_alpha_is_the_mask_where_it_says_something(tmp_path):
    cutout = np.dstack([np.full((20, 30, 3), 255, np.uint8), (255 * DISC).astype(np.uint8)])
    assert np.array_equal(read_mask(saved(tmp_path / "m.png", Image.fromarray(cutout))), DISC)


def test_two_colours_are_background_and_object(tmp_path):
    red = np.where(DISC[..., None], [200, 0, 0], [0, 0, 0]).astype(np.uint8)
    assert np.array_equal(read_mask(saved(tmp_path / "m.png", Image.fromarray(red))), DISC)
    index = Image.fromarray(DISC.astype(np.uint8), "P")
    index.putpalette([120, 0, 0, 0, 60, 0])  # by index: the first is brighter
    assert np.array_equal(read_mask(saved(tmp_path / "m.png", index)), DISC)


def test_one_value_is_all_or_nothing(tmp_path):
    for value, wanted in ((0, 0.0), (1, 1.0), (255, 1.0)):
        path = saved(tmp_path / "m.png", Image.new("L", (5, 4), value))
        assert (read_mask(path) == wanted).all()
    assert (read_mask(saved(tmp_path / "m.png", Image.new("RGB", (5, 4), (200, 0, 0)))) == 1.0).all()


def test_labels_and_colours_of_several_objects_are_refused(tmp_path):
    several = DISC.astype(np.uint8)
    several[:3] = 2
    index = Image.fromarray(several, "P")
    index.putpalette([0, 0, 0, 200, 0, 0, 0, 200, 0])
    for made, said in (
        (Image.fromarray(several), "3 labels"), (index, "3 labels"), (index.convert("RGB"), "3 colours"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=rf"m\.png: holds {said}; want a mask of one object"):
            read_mask(saved(tmp_path / "m.png", made))


def test_grids_have_one_channel_and_the_photographs_size(tmp_path):
    path = saved(tmp_path / "a.png", Image.fromarray(np.zeros((6, 8, 3), np.uint8)))
    with pytest.raises(ValueError, match=r"a\.png: want one channel, got 3"):
        read_grid(path, (8, 6))
    with pytest.raises(ValueError, match=r"a\.png: is 8 x 6 pixels, its photograph 6 x 8"):
        read_grid(path, (6, 8))
    depth = (1000 * RAMP).astype(np.uint16)
    assert np.array_equal(read_grid(saved(path, Image.fromarray(depth)), (8, 6)), depth)


# --- what the table of bug reports does not have ---


def test_the_first_of_several_pictures_in_a_file_is_taken_with_a_word(tmp_path, caplog):
    first, second = Image.fromarray(PIXELS), Image.new("RGB", (8, 6))
    for name, more in (("pages.tif", {}), ("moving.webp", {"lossless": True}), ("moving.png", {})):
        path = saved(tmp_path / name, first, save_all=True, append_images=[second], **more)
        assert read_header(path).shown == (8, 6)
        assert np.array_equal(read_picture(path).convert("RGB"), PIXELS), name
        assert f"{path}: holds 2 pictures, the first is taken" in caplog.text


def test_pictures_of_other_formats_are_left_out_with_a_count(tmp_path, caplog):
    saved(tmp_path / "a.jfif", Image.fromarray(PIXELS), format="JPEG")
    for name in ("b.HEIC", "c.gif", "._d.heic"):
        (tmp_path / name).write_bytes(b"?")
    assert [path.name for path in picture_files(tmp_path)] == ["a.jfif"]
    assert (
        f"{tmp_path}: 2 files such as b.HEIC have a format that is not read, and are left out" in caplog.text
    )


def shades(*values, dtype=np.uint8):
    """A picture of areas in these greys, on black."""
    grid = np.zeros((60, 80), dtype)
    for number, value in enumerate(values):
        grid[10:50, 5 + 25 * number : 25 + 25 * number] = value
    return Image.fromarray(grid)


@pytest.mark.parametrize(
    ("name", "picture"),
    [
        ("labels.png", shades(100, 200)),
        ("white_too.png", shades(90, 180, 255)),
        ("labels16.png", shades(700, 1400, dtype=np.uint16)),
        ("colours.jpg", Image.merge("RGB", [shades(255, 0), shades(0, 0), shades(0, 255)])),
    ],
)
def test_labels_in_greys_are_no_opacities(tmp_path, name, picture):
    with pytest.raises(ValueError, match=rf"{name}: holds \d+ shades; .*objects\.mask_value"):
        read_mask(saved(tmp_path / name, picture))


def test_soft_edges_and_narrow_uncertain_ones_are_opacities(tmp_path):
    grid = np.zeros((60, 80), np.uint8)
    grid[10:50, 10:60] = 128  # a trimap
    grid[14:46, 14:56] = 255
    assert set(np.unique(read_mask(saved(tmp_path / "trimap.png", Image.fromarray(grid))))) == {
        0.0,
        np.float32(128 / 255),
        1.0,
    }
    small = Image.fromarray(grid).resize((13, 10), Image.Resampling.BILINEAR)
    assert read_mask(saved(tmp_path / "small.png", small)).max() == 1.0

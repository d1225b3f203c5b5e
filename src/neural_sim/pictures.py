"""The one reader of pictures: targets, predictions, backgrounds, cut-outs, captures and textures.

Pictures become 8-bit RGB or RGBA as a viewer shows them, upright by their EXIF orientation. White is 65535 in 16-bit
grey and 1 in floats. A file that cannot be read raises ``ValueError``, with one line that names the file.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

_log = logging.getLogger(__name__)

Size = tuple[int, int]
"""Width and height in pixels."""
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".jfif", ".png", ".bmp", ".webp", ".tif", ".tiff")
OTHER_FORMATS = (".heic", ".heif", ".avif", ".gif", ".jxl", ".exr", ".dng", ".cr2", ".nef", ".arw", ".raw")
"""Suffixes of pictures that are not read, from phones, cameras, the web and renderers."""
CUTOUT_SUFFIXES = (".png", ".webp", ".tif", ".tiff")
"""Suffixes of formats with an alpha channel."""
LEFTOVERS = frozenset({"__MACOSX", "@eaDir", ".ipynb_checkpoints", ".thumbnails", ".Trashes", "$RECYCLE.BIN"})
"""Folders that other programs leave among pictures."""
APPLE_DOUBLE = "._"
"""Prefix of the files in which macOS keeps attributes of other files; they have the suffixes of those files."""

_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""The operation that turns a picture upright, by EXIF orientation."""
WHITE = 65535.0
"""White in 16 bits."""


# --- files ---


def picture_files(root: Path, suffixes: Collection[str] = PHOTO_SUFFIXES) -> list[Path]:
    """List the pictures under a folder, at any depth, sorted; the log counts the leftovers of other programs."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    say_strange(root, files, OTHER_FORMATS)
    return without_leftovers([path for path in files if path.suffix.lower() in suffixes], root)


def say_strange(root: Path, files: Iterable[Path], suffixes: Collection[str]) -> list[str]:
    """Log how many files have formats that are not read, and return their names."""
    strange = [
        path.name for path in files if path.suffix.lower() in suffixes and not _left_over(Path(path.name))
    ]
    if strange:
        _warn_once(
            "%s: %d files such as %s have a format that is not read, and are left out",
            root,
            len(strange),
            strange[0],
        )
    return strange


def without_leftovers(paths: Sequence[Path], root: Path) -> list[Path]:
    """Leave out the files that other programs left below ``root``, and log how many there are."""
    kept = [path for path in paths if not _left_over(path.relative_to(root))]
    if len(kept) < len(paths):
        example = next(path for path in paths if _left_over(path.relative_to(root)))
        left_out = len(paths) - len(kept)
        _warn_once("%s: %d leftovers of other programs are left out, such as %s", root, left_out, example)
    return kept


def _left_over(path: Path) -> bool:
    return any(part in LEFTOVERS or part.startswith(APPLE_DOUBLE) for part in path.parts)


@lru_cache(maxsize=1024)  # once, however often a folder is listed or a picture is read
def _warn_once(message: str, *about: object) -> None:
    _log.warning(message, *about)


# --- headers ---


@dataclass(frozen=True)
class Header:
    """What the header of a picture's file says.

    Args:
        stored: size of the picture as it is stored.
        orientation: EXIF orientation, 1 to 8; 1 is upright.
        mode: Pillow's name for the type of the pixels.
        format: Pillow's name for the format of the file.
        transparent: whether pixels may be transparent.
    """

    stored: Size
    orientation: int
    mode: str
    format: str | None
    transparent: bool

    @property
    def shown(self) -> Size:
        """The size of the upright picture."""
        return (self.stored[1], self.stored[0]) if self.orientation >= 5 else self.stored

    @property
    def turning(self) -> str:
        """An addition to messages about sizes that says how EXIF turns the picture; empty if it does not."""
        if self.orientation == 1:
            return ""
        return f"; its EXIF orientation {self.orientation} shows the stored {by(self.stored)} as {by(self.shown)}"


def read_header(path: Path, where: str = "") -> Header:
    """Read a picture's header.

    Args:
        path: the file.
        where: what messages begin with; empty: the path.

    Raises:
        ValueError: the file does not exist, or does not begin like a picture.
    """
    with _named(where or str(path)), Image.open(path) as image:
        # Phones keep a depth map as the second picture of an MPO file.
        count = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
        if count > 1:
            _warn_once("%s: holds %d pictures, the first is taken", path, count)
        return Header(image.size, _orientation(image), image.mode, image.format, image.has_transparency_data)


def read_exif(path: Path) -> dict[int, object]:
    """Return the values of a picture's EXIF by tag; empty if there is no EXIF, or it is damaged."""
    try:
        with Image.open(path) as image:
            held = image.getexif()
            return {**held, **held.get_ifd(ExifTags.IFD.Exif)}
    except Exception:  # Pillow's parsers raise many kinds
        return {}


def check_headers(paths: Iterable[Path], key: str) -> None:
    """Refuse pictures whose headers show that they cannot be read, before anything is computed.

    Args:
        paths: the files.
        key: the setting that they come from, for messages.

    Raises:
        ValueError: as ``read_header``, or a picture has a mode that ``read_picture`` refuses.
    """
    for path in paths:
        where = f"{key}: {path}"
        header = read_header(path, where)
        refuse_mode(header.mode, header.format, where)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 if there is none. Pillow turns TIFF itself."""
    known = any(key in image.info for key in ("exif", "Raw profile type exif", "xmp", "XML:com.adobe.xmp"))
    if image.format == "TIFF" or (
        image.format == "PNG" and not known
    ):  # reading EXIF would decode the whole PNG
        return 1
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    except Exception:  # Pillow raises many kinds on damaged EXIF, and the pixels may be sound
        return 1
    return orientation if orientation in _UPRIGHT else 1


@contextmanager
def _named(where: str) -> Iterator[None]:
    """Turn any error of Pillow on a damaged or unknown file into one line that names the file."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{where}: not a readable image ({reason})") from error


def by(size: tuple[float, ...]) -> str:
    """Return a size in words, such as 64 x 48."""
    return " x ".join(map(str, size))


# --- pictures ---


def read_picture(path: Path | BytesIO, where: str = "", upright: bool = True) -> Image.Image:
    """Read a picture in 8 bits: RGBA if its pixels may be transparent, else RGB.

    Args:
        path: the file, or its bytes.
        where: what messages begin with; empty: the path.
        upright: whether EXIF turns it; False keeps pixels as they are stored, to which the cameras of captures refer.

    Raises:
        ValueError: the file does not exist or cannot be read to its end, or its mode has no known black and white.
    """
    where = where or str(path)
    image, orientation = load(path, where)
    image = eight_bits(image, where)
    if upright and orientation in _UPRIGHT:
        image = image.transpose(_UPRIGHT[orientation])
        image.info.pop("exif", None)  # its orientation no longer holds
    return image


def load(path: Path | BytesIO, where: str) -> tuple[Image.Image, int]:
    """Read a picture as it is stored, and its EXIF orientation. Raises ``ValueError`` if it cannot be read."""
    with _named(where), Image.open(path) as image:
        if image.format != "PNG":
            return _decoded(image)
        image.verify()  # checksums, which decoding does not check
    if isinstance(path, BytesIO):
        path.seek(0)
    with _named(where), Image.open(path) as image:
        return _decoded(image)


def _decoded(image: Image.Image) -> tuple[Image.Image, int]:
    orientation = _orientation(image)
    image.load()
    return image, orientation


def eight_bits(image: Image.Image, where: str = "picture") -> Image.Image:
    """Return a picture of any mode as RGBA if its pixels may be transparent, else as RGB.

    Args:
        image: the picture.
        where: what messages begin with.

    Raises:
        ValueError: the mode has no known black and white, or values lie outside them.
    """
    refuse_mode(image.mode, image.format, where)
    if image.mode == "F" or image.mode.startswith("I"):
        return _scaled(image, where)
    with _named(where):
        return image.convert("RGBA" if image.has_transparency_data else "RGB")


def refuse_mode(mode: str, format: str | None, where: str) -> None:
    """Raise ``ValueError`` for a picture's mode that has no known black and white."""
    if mode == "I" and format not in ("PNG", "PPM"):  # these have at most 16 bits
        raise ValueError(f"{where}: 32-bit integers (mode I) have no known white; save it with 8 or 16 bits")
    if mode in ("LAB", "La"):
        raise ValueError(f"{where}: pictures of mode {mode} are not read; save it as RGB")


def _scaled(image: Image.Image, where: str) -> Image.Image:
    """Scale 16-bit grey, or floats in [0, 1], to 8 bits."""
    values, white = np.asarray(image), 1.0 if image.mode == "F" else WHITE
    if not (values.size and values.min() >= 0 and values.max() <= white):  # NaN is refused too
        raise ValueError(
            f"{where}: pictures of mode {image.mode} want values from 0 to {white:g}, got "
            f"{values.min():g} to {values.max():g}"
        )
    grey = Image.fromarray(np.rint(values.astype(np.float64) * (255.0 / white)).astype(np.uint8))
    clear = image.info.get("transparency")
    if clear is None:
        return grey.convert("RGB")
    made = grey.convert("RGBA")
    made.putalpha(Image.fromarray(np.where(values == clear, 0, 255).astype(np.uint8)))
    return made


def alpha_of(picture: Image.Image) -> Image.Image | None:
    """Return the alpha channel; None if there is none, or if it is opaque everywhere."""
    if not picture.has_transparency_data:
        return None
    alpha = picture.convert("RGBA").getchannel("A")
    return None if alpha.getextrema() == (255, 255) else alpha


# --- grids ---


def read_grid(path: Path, size: Size | None = None) -> np.ndarray:
    """Read the numbers [height, width] of a single-channel image, such as labels or depth, as they are stored.

    Args:
        path: the file.
        size: width and height that it must have; None: any.

    Raises:
        ValueError: the file does not exist, or has another size or several channels.
    """
    if size is not None and (got := read_header(path).stored) != size:
        raise ValueError(f"{path}: is {by(got)} pixels, its photograph {by(size)}")
    grid = np.asarray(load(path, str(path))[0])
    if grid.ndim != 2:
        raise ValueError(f"{path}: want one channel, got {grid.shape[2]}")
    return grid

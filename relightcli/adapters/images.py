"""Pictures in (and, from `image_output`, out) through OpenImageIO; in memory everything is scene-linear float32.

Rules, stated once:
- Integer files (8 or 16 bit PNG, JPEG, TIFF, ...) hold sRGB display values and are decoded to linear, unless the file
  says that it is linear. Float files (.exr, .hdr, float .tif) are linear as they are.
- Limits are checked in the header, before pixels are allocated: those of `relightcli.adapters.oiio`.
- Environments and textures: NaN and infinity are refused, negative values become 0.
- `read_image` keeps NaN, infinity and negative values: finding them is the business of `relightcli diff`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.image_output import (
    DISPLAY_SUFFIXES,
    LINEAR_SUFFIXES,
    WRITE_SUFFIXES,
    encode_image,
    write_image,
)
from relightcli.adapters.oiio import MAX_BYTES, MAX_CHANNELS, MAX_SIDE, REC709, first_line, load_oiio
from relightcli.core.display import decode_srgb
from relightcli.errors import InputError

__all__ = [
    "DISPLAY_SUFFIXES",
    "LINEAR_SUFFIXES",
    "WRITE_SUFFIXES",
    "Image",
    "encode_image",
    "read_environment",
    "read_environment_with_notes",
    "read_image",
    "read_texture",
    "write_image",
]


@dataclass(frozen=True)
class Image:
    """A picture as read. Alpha, where there is any, is associated (RGB is already multiplied by it).

    pixels   (H, W, C) float32, scene-linear; NaN and infinity as in the file
    names    C channel names, e.g. ("R", "G", "B", "A", "direct.R", ...)
    metadata the header's own keys: strings, numbers or tuples of numbers
    display  the file held display values (sRGB, 0..1), which have been decoded
    notes    what a user should know about how it was read
    """

    pixels: NDArray[np.float32]
    names: tuple[str, ...]
    metadata: dict[str, Any]
    display: bool = False
    notes: tuple[str, ...] = ()

    def layers(self) -> dict[str, list[int]]:
        """Channel indices by layer; the picture itself is the layer "" (channels without a dot in their name)."""
        groups: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            groups.setdefault(name.rpartition(".")[0], []).append(index)
        return groups


def read_image(path: str | Path) -> Image:
    """Read any picture OpenImageIO knows, with all its channels, placed in its display window.

    Raises InputError for files that are missing, foreign, truncated or over the limits.
    """
    raw = _read(Path(path))
    pixels = raw.pixels
    if raw.straight_alpha is not None:
        alpha = raw.straight_alpha
        colour = [c for c in range(pixels.shape[2]) if c != alpha]
        pixels[..., colour] *= pixels[..., alpha : alpha + 1]
    return Image(pixels, raw.names, raw.metadata, raw.display, raw.notes)


def read_environment(path: str | Path) -> NDArray[np.float32]:
    """Read a latitude-longitude map as (H, W, 3) float32 radiance, row 0 at +Y. See `read_environment_with_notes`."""
    return read_environment_with_notes(path)[0]


def read_environment_with_notes(path: str | Path) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Read a latitude-longitude map and say what had to be changed in it.

    Grey becomes RGB, alpha is dropped, negative values become 0 (with a note). Any aspect ratio is taken as spanning
    the whole sphere (with a note if it is not 2:1).

    Returns radiance (H, W, 3) float32, finite, >= 0, and notes.
    Raises InputError for NaN or infinite pixels (count and first pixel), cube maps, and all that `read_image` refuses.
    """
    path = Path(path)
    raw = _read(path)
    if "cube" in str(raw.metadata.get("textureformat", "")).lower():
        raise InputError(f"{path}: is a cube map; expected a latitude-longitude map (2:1, row 0 at the zenith).")
    notes = list(raw.notes)
    height, width = raw.pixels.shape[:2]
    if width != 2 * height and (width, height) != (1, 1):
        notes.append(f"{path.name}: {width}x{height} is not 2:1; taken as a latitude-longitude map all the same.")
    rgb, negative = _clean_rgb(path, raw)
    if negative:
        notes.append(negative)
    return rgb, tuple(notes)


def read_texture(path: str | Path) -> NDArray[np.float32]:
    """Read a reflectance texture as (H, W, 3) float32 linear, row 0 at the top of the picture.

    Grey becomes RGB, alpha is dropped, negative values become 0.
    Raises InputError as `read_environment` does.
    """
    path = Path(path)
    return _clean_rgb(path, _read(path))[0]


@dataclass(frozen=True)
class _Raw:
    pixels: NDArray[np.float32]  # (H, W, C), linear
    names: tuple[str, ...]
    metadata: dict[str, Any]
    display: bool
    straight_alpha: int | None  # index of an alpha channel that RGB has not been multiplied with
    notes: tuple[str, ...]


def _read(path: Path) -> _Raw:
    try:
        return _read_decoded(path)
    except UnicodeDecodeError:  # the library's message quotes the file
        raise InputError(f"{path}: cannot be read as a picture (its header is damaged).") from None


def _read_decoded(path: Path) -> _Raw:
    oiio = load_oiio()
    if not path.exists():
        raise InputError(f"{path}: no such file; expected a picture.")
    if not path.is_file():
        raise InputError(f"{path}: is not a regular file; expected a picture.")
    try:  # OpenImageIO takes names as UTF-8, whatever the locale
        name = os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{str(path)!r}: its name is not UTF-8; rename it.") from None
    wish = oiio.ImageSpec()
    wish.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(name, wish)
    if source is None:
        raise InputError(f"{path}: cannot be read as a picture ({first_line(oiio.geterror())}).")
    try:
        spec = source.spec()
        _check_header(path, source.format_name(), spec)
        pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        # Some readers (JPEG) hand out what they have of a truncated file and only leave a message.
        trouble = source.geterror()
        if pixels is None or trouble:
            raise InputError(f"{path}: is damaged or cut short ({first_line(trouble)}).")
        notes = []
        if source.seek_subimage(1, 0) and source.format_name() in ("openexr", "tiff"):
            notes.append(f"{path.name}: has more than one part; only the first was read.")
        source.geterror()  # not having a second part is no error
    finally:
        source.close()
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)

    alpha = spec.alpha_channel if 0 <= spec.alpha_channel < spec.nchannels else None
    is_integer = spec.format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    space = spec.get_string_attribute("oiio:ColorSpace").lower()
    display = is_integer and not space.startswith("lin")
    if display:
        colour = [c for c in range(spec.nchannels) if c != alpha]
        pixels[..., colour] = decode_srgb(pixels[..., colour])
        if space and not space.startswith("srgb"):
            notes.append(f"{path.name}: is marked {space}; decoded as sRGB.")
    primaries = spec.getattribute("chromaticities")
    if primaries is not None and (np.shape(primaries) != (8,) or not np.allclose(primaries, REC709, atol=1e-3)):
        notes.append(f"{path.name}: its primaries are not Rec.709; its values were taken as they are.")

    metadata = {a.name: a.value for a in spec.extra_attribs if isinstance(a.value, str | int | float | tuple)}
    straight = alpha if is_integer and spec.get_int_attribute("oiio:UnassociatedAlpha") else None
    pixels = _upright(_display_window(pixels, spec), spec.get_int_attribute("Orientation", 1))
    return _Raw(np.ascontiguousarray(pixels), tuple(spec.channelnames), metadata, display, straight, tuple(notes))


def _check_header(path: Path, format_name: str, spec: Any) -> None:
    if format_name == "null" or spec.deep or spec.depth > 1:
        kind = "a deep picture" if spec.deep else "a volume" if spec.depth > 1 else "no picture"
        raise InputError(f"{path}: is {kind}; expected a flat picture.")
    width, height = max(spec.width, spec.full_width), max(spec.height, spec.full_height)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and spec.width >= 1 and spec.height >= 1):
        raise InputError(f"{path}: is {width}x{height} pixels; expected 1 to {MAX_SIDE} each way.")
    if not 1 <= spec.nchannels <= MAX_CHANNELS:
        raise InputError(f"{path}: has {spec.nchannels} channels; expected 1 to {MAX_CHANNELS}.")
    size = 4 * width * height * spec.nchannels
    if size > MAX_BYTES:
        limit = MAX_BYTES >> 20
        raise InputError(f"{path}: would take {size >> 20} MiB in memory; expected at most {limit} MiB.")


def _display_window(pixels: NDArray[np.float32], spec: Any) -> NDArray[np.float32]:
    """Cut what hangs over the display window, fill with 0 what the data window leaves out."""
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    if (left, top, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return pixels
    if spec.full_width < 1 or spec.full_height < 1:
        return pixels
    window = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), np.float32)
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + spec.width, spec.full_width), min(top + spec.height, spec.full_height)
    if x1 > x0 and y1 > y0:
        window[y0:y1, x0:x1] = pixels[y0 - top : y1 - top, x0 - left : x1 - left]
    return window


def _upright(pixels: NDArray[np.float32], orientation: int) -> NDArray[np.float32]:
    """Undo the Exif orientation (1 to 8) with which cameras and Radiance headers mark turned pictures."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels


def _clean_rgb(path: Path, raw: _Raw) -> tuple[NDArray[np.float32], str]:
    """RGB without alpha, finite and >= 0, and a note on what was clamped."""
    lower = [name.lower() for name in raw.names]
    if {"r", "g", "b"} <= set(lower):
        picked = [lower.index(c) for c in "rgb"]
    else:
        colours = [i for i, name in enumerate(lower) if name not in ("a", "alpha", "z")]
        if len(colours) != 1:
            raise InputError(f"{path}: has the channels {', '.join(raw.names)}; expected R, G, B or one grey channel.")
        picked = colours * 3
    rgb = np.ascontiguousarray(raw.pixels[..., picked])
    broken = ~np.isfinite(rgb).all(axis=2)
    if broken.any():
        y, x = np.argwhere(broken)[0]
        raise InputError(
            f"{path}: {int(broken.sum())} pixels are NaN or infinite, the first at x={x}, y={y} "
            f"({', '.join(f'{v:g}' for v in rgb[y, x])}); expected finite radiance. Repair the picture first."
        )
    below = (rgb < 0).any(axis=2)
    if not below.any():
        return rgb, ""
    least = float(rgb.min())
    np.maximum(rgb, 0, out=rgb)
    return rgb, f"{path.name}: {int(below.sum())} pixels had negative values (down to {least:g}); set to 0."

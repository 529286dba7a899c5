"""Pictures out: EXR, Radiance HDR and TIFF as scene-linear floats, PNG and JPEG as 8-bit sRGB.

A picture is first made in memory and then put on disk in one step: a full disk shows as an OSError that says so, and
the same picture always gives the same bytes.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.files import write_atomic
from relightcli.adapters.oiio import REC709, first_line, load_oiio
from relightcli.core.display import to_display
from relightcli.errors import InputError, SystemFault

LINEAR_SUFFIXES = (".exr", ".hdr", ".tif", ".tiff")
DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg")
WRITE_SUFFIXES = LINEAR_SUFFIXES + DISPLAY_SUFFIXES

# Written into every EXR, because the time of day would make equal pictures differ in their bytes.
FIXED_DATE = "1970:01:01 00:00:00"


def write_image(
    path: str | Path,
    pixels: NDArray[np.floating[Any]],
    *,
    layers: Mapping[str, NDArray[np.floating[Any]]] | None = None,
    metadata: Mapping[str, str | int | float] | None = None,
    exposure: float = 0.0,
) -> None:
    """Write a picture in one step, in the format of the suffix. Parameters as `encode_image`.

    Raises InputError for an unknown suffix or a missing folder; OSError (disk full, no permission) as it comes.
    """
    try:
        data = encode_image(Path(path).suffix, pixels, layers=layers, metadata=metadata, exposure=exposure)
    except OSError as error:
        error.filename = str(path)  # it was the memory file's
        raise
    write_atomic(path, data)


def write_display(path: str | Path, display: NDArray[np.uint8]) -> None:
    """Write (H, W, 3) uint8 display sRGB as it is, in one step. The suffix must be .png or .jpg."""
    suffix = Path(path).suffix.lower()
    if suffix not in DISPLAY_SUFFIXES:
        raise InputError(f"{path}: expected a name ending in {' or '.join(DISPLAY_SUFFIXES)}.")
    write_atomic(path, _encode_pillow(suffix, display, {}))


def encode_image(
    suffix: str,
    pixels: NDArray[np.floating[Any]],
    *,
    layers: Mapping[str, NDArray[np.floating[Any]]] | None = None,
    metadata: Mapping[str, str | int | float] | None = None,
    exposure: float = 0.0,
) -> bytes:
    """The bytes of a picture file; the same picture gives the same bytes.

    suffix    ".exr" (float32, zip), ".hdr" (RGBE), ".tif" (float32, zip): linear, `exposure` does not apply;
              ".png", ".jpg": 8-bit sRGB of pixels * 2^exposure (NaN shows as black, infinity as white)
    pixels    (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) scene-linear; alpha associated (PNG gets it unassociated; .hdr
              and .jpg have none and show the picture over black)
    layers    .exr only: name -> (H, W), (H, W, 1) or (H, W, 3), stored as name.Y or name.R/.G/.B
    metadata  own header keys: EXR attributes of their names; elsewhere one JSON text as description (not .hdr)
    exposure  stops

    Raises InputError for an unknown suffix, for layers outside .exr, and for shapes that do not fit.
    """
    suffix = suffix.lower()
    if suffix not in WRITE_SUFFIXES:
        raise InputError(f"cannot write {suffix or 'a file without a suffix'}; expected one of {_listed()}.")
    if layers and suffix != ".exr":
        raise InputError(f"layers can only be kept in .exr, not in {suffix}; write .exr or leave them out.")
    picture, names = _channels("", pixels)
    if suffix in DISPLAY_SUFFIXES:
        return _encode_display(suffix, picture, dict(metadata or {}), exposure)
    planes = [picture]
    for layer, values in (layers or {}).items():
        plane, layer_names = _channels(layer, values)
        if plane.shape[:2] != picture.shape[:2]:
            raise InputError(f"layer {layer} is {_size(plane)}; expected {_size(picture)}, the picture's size.")
        planes.append(plane)
        names += layer_names
    return _encode_linear(suffix, np.concatenate(planes, axis=2), names, dict(metadata or {}))


def _channels(layer: str, values: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], list[str]]:
    """(H, W, C) float32 and the channel names of a picture (layer "") or of one layer."""
    array = np.asarray(values, np.float32)
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise InputError(
            f"{layer or 'picture'} has the shape {np.shape(values)}; expected (H, W) or (H, W, 1, 3 or 4)."
        )
    letters = "Y" if array.shape[2] == 1 else "RGBA"[: array.shape[2]]
    return array, [f"{layer}.{c}" if layer else c for c in letters]


def _encode_display(suffix: str, picture: NDArray[np.float32], metadata: dict[str, Any], exposure: float) -> bytes:
    colour = picture[..., :3]
    alpha = picture[..., 3:] if picture.shape[2] == 4 and suffix == ".png" else None
    if alpha is not None:
        colour = np.divide(colour, alpha, out=np.zeros_like(colour), where=alpha > 0)
    display = to_display(colour, exposure)
    if alpha is not None:
        coverage = np.nan_to_num(np.clip(alpha, 0, 1))
        display = np.concatenate([display, np.rint(coverage * 255).astype(np.uint8)], axis=2)
    return _encode_pillow(suffix, display, metadata)


def _encode_pillow(suffix: str, display: NDArray[np.uint8], metadata: dict[str, Any]) -> bytes:
    # Pillow, because OpenImageIO's JPEG writer ends the process when a disk is full, and both can be had in memory.
    from PIL import Image as PillowImage
    from PIL import PngImagePlugin

    image = PillowImage.fromarray(display[..., 0] if display.shape[2] == 1 else display)
    text = json.dumps(metadata, sort_keys=True) if metadata else ""
    stream = io.BytesIO()
    if suffix == ".png":
        info = PngImagePlugin.PngInfo()
        info.add(b"sRGB", b"\x00")  # rendering intent: perceptual
        if text:
            info.add_text("Description", text)
        image.save(stream, "PNG", pnginfo=info)
    else:
        image.save(stream, "JPEG", quality=95, subsampling=0, comment=text.encode())
    return stream.getvalue()


def _encode_linear(suffix: str, pixels: NDArray[np.float32], names: list[str], metadata: dict[str, Any]) -> bytes:
    oiio = load_oiio()
    form = {".exr": "openexr", ".hdr": "hdr"}.get(suffix, "tiff")
    if form == "hdr":
        # RGBE has three channels, no sign and an 8-bit exponent.
        pixels = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
        pixels = _round_to_rgbe(np.clip(np.nan_to_num(pixels, nan=0.0), 0, np.float32(1e38)))
        names = ["R", "G", "B"]
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, oiio.FLOAT)
    spec.channelnames = tuple(names)
    spec.alpha_channel = names.index("A") if "A" in names else -1
    spec.attribute("Software", "relightcli")
    spec.attribute("DateTime", FIXED_DATE)
    if form != "hdr":
        spec.attribute("compression", "zip")
    if form == "openexr":
        spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
        spec.attribute("colorInteropID", "lin_rec709_scene")
        spec.attribute("chromaticities", "float[8]", REC709)
        for key, value in metadata.items():
            # OpenImageIO takes UTF-8; paths may hold bytes that are none.
            spec.attribute(key, os.fsencode(value).decode("utf-8", "replace") if isinstance(value, str) else value)
    elif metadata:
        spec.attribute("ImageDescription", json.dumps(metadata, sort_keys=True))
    with _memory_file(suffix) as (name, read):
        target = oiio.ImageOutput.create(form)
        fine = target is not None and target.open(name, spec)
        fine = fine and target.write_image(np.ascontiguousarray(pixels))
        fine = fine and target.close()
        if not fine:
            _need_room(name, pixels.nbytes)
            trouble = target.geterror() if target is not None else oiio.geterror()
            raise SystemFault(f"could not encode a {suffix} picture ({first_line(trouble)}).")
        _need_room(name, 0)
        return read()


def _need_room(name: str, size: int) -> None:
    """Raises OSError where the file cannot be longer than it is and than `size` bytes: the system's reason, which the
    library does not pass on. Files in memory are under a limit on file sizes as others are; writers of TIFF and of HDR
    end well when it has cut off what they wrote last."""
    with contextlib.suppress(FileNotFoundError):
        end = os.stat(name).st_size
        os.truncate(name, max(end, size) + 2)  # 2: a TIFF's directory begins at an even place
        os.truncate(name, end)


def _round_to_rgbe(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Round to 8 bits below the pixel's largest value: OpenImageIO truncates, which darkens by half a step."""
    exponent = np.frexp(rgb.max(axis=2, keepdims=True))[1]
    rounded: NDArray[np.float32] = np.ldexp(np.rint(np.ldexp(rgb, 8 - exponent)), exponent - 8)
    return rounded


@contextlib.contextmanager
def _memory_file(suffix: str) -> Iterator[tuple[str, Callable[[], bytes]]]:
    """A file name for a library that only writes to names, and a function that gives what was written.

    In memory where the system can do it: a full disk then shows in `write_atomic`, as an OSError that says so.
    """
    if hasattr(os, "memfd_create") and os.path.isdir("/proc/self/fd"):
        descriptor = os.memfd_create("relightcli")
        try:
            name = f"/proc/self/fd/{descriptor}"
            yield name, lambda: Path(name).read_bytes()
        finally:
            os.close(descriptor)
    else:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"picture{suffix}"
            yield str(file), file.read_bytes


def _size(pixels: NDArray[np.float32]) -> str:
    return f"{pixels.shape[1]}x{pixels.shape[0]}"


def _listed() -> str:
    return ", ".join(WRITE_SUFFIXES)

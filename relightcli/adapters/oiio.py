"""OpenImageIO, loaded when first needed, with limits fit for files of unknown origin."""

from __future__ import annotations

import functools
from typing import Any

MAX_SIDE = 16384  # pixels
MAX_CHANNELS = 64
MAX_BYTES = 4 << 30  # of one decoded picture, float32
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue, white


@functools.cache
def load_oiio() -> Any:
    import OpenImageIO as oiio

    # The library's own limits are 1,024 channels and 24 GB.
    oiio.attribute("limits:channels", MAX_CHANNELS)
    oiio.attribute("limits:resolution", MAX_SIDE)
    oiio.attribute("limits:imagesize_MB", MAX_BYTES >> 20)
    return oiio


def first_line(message: str) -> str:
    return message.strip().split("\n")[0] or "no reason given"


def picture_suffixes() -> frozenset[str]:
    """Suffixes of all formats that can be read, lower case with the dot."""
    listed: str = load_oiio().get_string_attribute("extension_list")  # "openexr:exr,sxr,mxr;tiff:tif,tiff,..."
    return frozenset("." + s.lower() for group in listed.split(";") for s in group.partition(":")[2].split(",") if s)

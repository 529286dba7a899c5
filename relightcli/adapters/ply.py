"""Coloured vertices as PLY: exit radiance as floats, and 8-bit display colours for mesh viewers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.files import write_atomic
from relightcli.core.display import to_display
from relightcli.errors import InputError


def write_ply(
    path: str | Path,
    positions: NDArray[np.floating[Any]],
    faces: NDArray[np.integer[Any]],
    radiance: NDArray[np.floating[Any]],
    exposure: float = 0.0,
) -> None:
    """Write a binary little-endian PLY in one step. Parameters as `encode_ply`; errors as `write_atomic`."""
    write_atomic(path, encode_ply(positions, faces, radiance, exposure))


def encode_ply(
    positions: NDArray[np.floating[Any]],
    faces: NDArray[np.integer[Any]],
    radiance: NDArray[np.floating[Any]],
    exposure: float = 0.0,
) -> bytes:
    """The bytes of a binary little-endian PLY; the same input gives the same bytes.

    positions (V, 3): x, y, z, written as float32; faces (F, 3): vertex indices; radiance (V, 3): scene-linear Rec.709,
    written as float properties radiance_r, radiance_g, radiance_b, and, times 2^exposure, as sRGB red, green, blue.
    Raises InputError for shapes that do not fit.
    """
    if positions.ndim != 2 or positions.shape[1] != 3 or radiance.shape != positions.shape:
        raise InputError(f"PLY positions are {positions.shape}, radiance {radiance.shape}; expected (V, 3) for both.")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"PLY faces are {faces.shape}; expected (F, 3).")
    floats = ("x", "y", "z", "radiance_r", "radiance_g", "radiance_b")
    colours = ("red", "green", "blue")
    vertices = np.empty(len(positions), [(name, "<f4") for name in floats] + [(name, "u1") for name in colours])
    display = to_display(radiance, exposure)
    for axis in range(3):
        vertices[floats[axis]] = positions[:, axis]
        vertices[floats[3 + axis]] = radiance[:, axis]
        vertices[colours[axis]] = display[:, axis]
    triangles = np.empty(len(faces), [("count", "u1"), ("indices", "<i4", (3,))])
    triangles["count"], triangles["indices"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in floats] + [f"property uchar {name}" for name in colours]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode("ascii") + vertices.tobytes() + triangles.tobytes()

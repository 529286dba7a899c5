"""The built-in demo scene: a paved court with an arcade, four objects, a camera and three skies, all made here."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.scene.shapes import Mesh, arc_beam, join, lathe, patch, rounded, torus_knot, tube

_COURT_CELLS = 144
_COURT_EVEN = 4.0  # metres from the middle that have evenly spaced cells
_COURT_RIM = 10  # cells beyond them on either side, each wider than the one before
_COURT_HALF = 100.0  # metres from the middle to the edge, far enough to reach the horizon
_TEXTURE = 1024
_SAND = (0.42, 0.38, 0.31)  # albedo around the court, and of the ground in the skies, so that they meet unseen

_SCENE = """\
# The demo scene of relightcli. Try: change a material, move an object, add a camera.
format = 1

[objects.court]
mesh = "court.obj"
material = "paving"

[objects.arcade]
mesh = "arcade.ply"
material = "stone"

[objects.plinth]
mesh = "plinth.ply"
material = "slate"

[objects.knot]
mesh = "knot.ply"
material = "gold"
rotate = [0, 1, 0, 20]
translate = [0, 1.18, 0]

[objects.ball]
mesh = "ball.ply"
material = "red"
translate = [-1.25, 0, 0.75]

[objects.block]
mesh = "block.ply"
material = "teal"
rotate = [0, 1, 0, 28]
translate = [1.3, 0, 0.35]

[objects.hoop]
mesh = "hoop.ply"
material = "ivory"
rotate = [0, 1, 0, -35]
translate = [0.5, 0, 1.5]

[materials.paving]
model = "lambert"
diffuse = [1, 1, 1]
diffuse_texture = "paving.png"

[materials.stone]
model = "lambert"
diffuse = [0.62, 0.57, 0.48]

[materials.slate]
model = "lambert"
diffuse = [0.20, 0.21, 0.23]

[materials.gold]
model = "cook-torrance"
diffuse = [0.10, 0.055, 0.012]
specular = [0.90, 0.58, 0.20]
f0 = 0.9
roughness = 0.25
adjustable = true

[materials.red]
model = "blinn-phong"
diffuse = [0.50, 0.06, 0.04]
specular = [0.12, 0.12, 0.12]
shininess = 80
adjustable = true

[materials.teal]
model = "lambert"
diffuse = [0.08, 0.36, 0.40]
adjustable = true

[materials.ivory]
model = "blinn-phong"
diffuse = [0.60, 0.55, 0.42]
specular = [0.10, 0.10, 0.10]
shininess = 25

[environments.sky-noon]
map = "sky-noon.exr"

[environments.sky-morning]
map = "sky-morning.exr"

[environments.sky-overcast]
map = "sky-overcast.exr"

[cameras.main]
eye = [1.3, 2.3, 6.3]
target = [0.16, 0.86, -0.2]
fov = 34
size = [640, 480]

[cameras.close]
eye = [-2.3, 1.5, 4.4]
target = [-0.12, 0.8, 0.2]
fov = 36
size = [640, 480]

# What main sees, in a quarter of the pixels: for sequences and the reference.
[cameras.small]
eye = [1.3, 2.3, 6.3]
target = [0.16, 0.86, -0.2]
fov = 34
size = [320, 240]

[accuracy]
tolerance = 0.02
"""


def write_demo_scene(folder: str | Path) -> Path:
    """Write the demo scene with its meshes, texture and skies into `folder`, which is made if need be.

    Files that are there already are replaced; the same version writes the same bytes.
    Returns the path of the scene file. Raises InputError or OSError as `write_atomic` does.
    """
    from relightcli.adapters.files import write_atomic
    from relightcli.adapters.images import write_image
    from relightcli.core.lights.sky import sky_latlong

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, mesh in _meshes().items():
        write_atomic(folder / f"{name}.ply", _ply(mesh))
    write_atomic(folder / "court.obj", _court().encode())
    write_image(folder / "paving.png", _paving())
    write_image(folder / "sky-noon.exr", sky_latlong(58.0, 310.0, 3.0, ground=_SAND))
    write_image(folder / "sky-morning.exr", sky_latlong(20.0, 252.0, 3.0, ground=_SAND))
    write_image(folder / "sky-overcast.exr", sky_latlong(45.0, overcast=True, ground=_SAND))
    scene = folder / "scene.toml"
    write_atomic(scene, _SCENE.encode())
    return scene


def _meshes() -> dict[str, Mesh]:
    """Everything but the ground."""
    return {
        "arcade": _arcade(),
        "plinth": rounded((0.9, 0.62, 0.9), power=10, round_plan=True),
        "knot": tube(torus_knot(2, 3, 0.34, 0.15, 240), 0.085, 20),
        "ball": rounded((0.84, 0.84, 0.84), power=2),
        "block": rounded((0.8, 0.8, 0.8), power=6),
        "hoop": _hoop(),
    }


def _arcade() -> Mesh:
    """Nine thin columns on an arc behind the middle, and the beam that they carry."""
    column, beam_low, radius = 0.075, 1.86, 2.6
    profile = [
        (1.7 * column, 0.002),
        (1.7 * column, 0.06),
        (1.15 * column, 0.11),
        *(((1.0 - 0.1 * t**1.5) * column, 0.18 + 1.48 * t) for t in np.linspace(0, 1, 16)),  # close enough for shadows
        (1.0 * column, 1.74),
        (1.55 * column, 1.8),
        (1.55 * column, beam_low),
    ]
    one, faces = lathe(profile, 18)
    angles = np.radians(np.linspace(8, 172, 9))
    columns = [(one + np.array([radius * math.cos(a), 0.0, -radius * math.sin(a)]), faces) for a in angles]
    beam = arc_beam(radius, 0.3, beam_low, beam_low + 0.2, math.radians(3), math.radians(177), 90)
    return join([*columns, beam])


def _hoop() -> Mesh:
    """An upright ring that stands on the ground."""
    t = 2 * math.pi * np.arange(96) / 96
    centers = 0.36 * np.stack([np.cos(t), np.sin(t), np.zeros_like(t)], axis=1)
    positions, faces = tube(centers, 0.045, 12)
    return positions + np.array([0.0, 0.405, 0.0]), faces


def _spread(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grid parameter in -1..1 to metres: even cells in the middle, then each wider by one factor up to the edge."""
    even = _COURT_CELLS / 2 - _COURT_RIM
    cells = np.abs(t) * _COURT_CELLS / 2
    factor = (_COURT_HALF / _COURT_EVEN) ** (1 / _COURT_RIM)
    return np.sign(t) * np.where(cells < even, cells / even, factor ** np.maximum(cells - even, 0)) * _COURT_EVEN


def _court() -> str:
    """The ground as an OBJ file. Texture coordinates follow the grid, so the texture is drawn in the grid's spacing."""
    t = np.linspace(-1, 1, _COURT_CELLS + 1)
    x, z = np.meshgrid(_spread(t), _spread(t), indexing="ij")
    positions, faces = patch(np.stack([x, np.zeros_like(x), z], axis=-1)[:, ::-1])
    u, v = np.meshgrid((t + 1) / 2, (t[::-1] + 1) / 2, indexing="ij")
    lines = [f"v {px:.6g} {py:.6g} {pz:.6g}" for px, py, pz in positions + 0.0]
    lines += [f"vt {a:.6g} {1 - b:.6g}" for a, b in zip(u.ravel(), v.ravel(), strict=True)]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"


def _paving() -> NDArray[np.float32]:
    """Albedo (1024, 1024, 3): a round court of pale and darker slabs with a rim, even sand outside."""
    fine = 2 * _TEXTURE  # every texel averages four points
    t = 2 * (np.arange(fine) + 0.5) / fine - 1
    x, z = np.meshgrid(_spread(t), _spread(t), indexing="xy")
    radius, angle = np.hypot(x, z), np.arctan2(z, x)
    dark = (np.floor(radius / 0.42) + np.floor(angle * 24 / (2 * math.pi))) % 2
    light, deep = np.array([0.60, 0.53, 0.42]), np.array([0.31, 0.26, 0.21])
    rim = np.array([0.24, 0.20, 0.16])
    colour = light + dark[..., None] * (deep - light)
    colour[radius > 7 * 0.42] = rim
    colour[radius > 3.15] = _SAND
    averaged: NDArray[np.float32] = colour.reshape(_TEXTURE, 2, _TEXTURE, 2, 3).mean(axis=(1, 3)).astype(np.float32)
    return averaged


def _ply(mesh: Mesh) -> bytes:
    """Binary little-endian PLY."""
    positions, faces = mesh
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made by relightcli\n"
        f"element vertex {len(positions)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    corners = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    corners["n"], corners["v"] = 3, faces
    return header.encode() + positions.astype("<f4").tobytes() + corners.tobytes()


if __name__ == "__main__":
    print(write_demo_scene(sys.argv[1]))

"""A red ball on a floor under an overcast sky: make_scene.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
import trimesh

from relightcli.adapters.images import write_image
from relightcli.core.lights.sky import sky_latlong

SCENE = """\
format = 1

[objects.ball]
mesh = "ball.ply"
material = "red"
translate = [0, 0.5, 0]

[objects.floor]
mesh = "floor.ply"
material = "grey"

[materials.red]
diffuse = [0.6, 0.1, 0.08]
adjustable = true

[materials.grey]
diffuse = [0.5, 0.5, 0.5]

[environments.sky]
map = "sky.exr"

[cameras.main]
eye = [0, 1.2, 3]
target = [0, 0.4, 0]
fov = 35
size = [160, 120]
"""

CELLS = 100
HALF = 3.0  # metres from the middle of the floor to its edge


def floor() -> trimesh.Trimesh:
    """A square of CELLS x CELLS cells: light is computed at vertices, so a shadow needs some to fall on."""
    x, z = np.meshgrid(*2 * [np.linspace(-HALF, HALF, CELLS + 1)], indexing="ij")
    corner = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return trimesh.Trimesh(np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3), faces, process=False)


folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
trimesh.creation.icosphere(subdivisions=4, radius=0.5).export(folder / "ball.ply")
floor().export(folder / "floor.ply")
write_image(folder / "sky.exr", sky_latlong(40.0, overcast=True))
(folder / "scene.toml").write_text(SCENE)

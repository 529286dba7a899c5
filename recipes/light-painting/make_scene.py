"""A knot on a floor, and the maps of a sky that is painted on: make_scene.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
import trimesh

from relightcli.adapters.images import write_image
from relightcli.core.lights.sky import sky_latlong
from relightcli.scene.shapes import torus_knot, tube

SCENE = """\
format = 1

[objects.knot]
mesh = "knot.ply"
material = "white"
translate = [0, 0.65, 0]

[objects.floor]
mesh = "floor.ply"
material = "grey"

[materials.white]
diffuse = [0.7, 0.7, 0.7]

[materials.grey]
diffuse = [0.5, 0.5, 0.5]

[cameras.main]
eye = [0, 1.6, 3]
target = [0, 0.4, 0]
fov = 35
size = [240, 180]
"""

FLOOR = [[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]]  # metres; precompute cuts it finer
# Row, column, radius in degrees, colour of each stroke.
STROKES = (
    (35, 150, 6, (30, 10, 4)),
    (50, 260, 4, (4, 12, 40)),
    (20, 200, 3, (30, 30, 25)),
    (60, 100, 8, (3, 9, 3)),
    (35, 150, 6, (-30, -10, -4)),  # the first one is painted over again
)

folder = Path(sys.argv[1])
(folder / "maps").mkdir(parents=True, exist_ok=True)
trimesh.Trimesh(*tube(torus_knot(2, 3, 0.42, 0.18, 160), 0.11, 24), process=False).export(folder / "knot.ply")
trimesh.Trimesh(FLOOR, [[0, 1, 2], [0, 2, 3]]).export(folder / "floor.ply")
sky = sky_latlong(45.0, overcast=True)
sky = np.asarray(sky / sky.mean() * 0.1, np.float32)
height, width = sky.shape[:2]
row, column = np.mgrid[0:height, 0:width]
write_image(folder / "maps" / "00.exr", sky)
for k, (at_row, at_column, radius, colour) in enumerate(STROKES, 1):
    y, x = (row + 0.5) * 180 / height - at_row, (column + 0.5) * 360 / width - at_column
    inside = (x * np.sin(np.radians(at_row))) ** 2 + y**2 < radius**2
    sky = sky + inside[..., None] * np.float32(colour)
    write_image(folder / "maps" / f"{k:02d}.exr", np.maximum(sky, 0))
(folder / "scene.toml").write_text(SCENE)

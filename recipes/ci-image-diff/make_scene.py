"""A red ball on a floor under an overcast sky: make_scene.py FOLDER."""

import sys
from pathlib import Path

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

FLOOR = [[-3, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]]  # metres; precompute cuts it finer

folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
trimesh.creation.icosphere(subdivisions=4, radius=0.5).export(folder / "ball.ply")
trimesh.Trimesh(FLOOR, [[0, 1, 2], [0, 2, 3]]).export(folder / "floor.ply")
write_image(folder / "sky.exr", sky_latlong(40.0, overcast=True))
(folder / "scene.toml").write_text(SCENE)

"""A torus on a floor, and a folder of skies from dawn to noon: make_scene.py FOLDER."""

import sys
from pathlib import Path

import trimesh

from relightcli.adapters.images import write_image
from relightcli.core.lights.sky import sky_latlong

SCENE = """\
format = 1

[objects.torus]
mesh = "torus.ply"
material = "blue"
rotate = [1, 0, 0, 60]
translate = [0, 0.55, 0]

[objects.floor]
mesh = "floor.ply"
material = "grey"

[materials.blue]
diffuse = [0.1, 0.2, 0.5]

[materials.grey]
diffuse = [0.5, 0.5, 0.5]

[cameras.main]
eye = [0, 1.2, 3]
target = [0, 0.4, 0]
fov = 35
size = [160, 120]
"""

FLOOR = [[-3, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]]  # metres; precompute cuts it finer
ELEVATIONS = (15, 35, 60)  # of the sun, degrees

folder = Path(sys.argv[1])
(folder / "maps").mkdir(parents=True, exist_ok=True)
trimesh.creation.torus(0.45, 0.15, major_sections=64, minor_sections=32).export(folder / "torus.ply")
trimesh.Trimesh(FLOOR, [[0, 1, 2], [0, 2, 3]]).export(folder / "floor.ply")
for elevation in ELEVATIONS:
    sky = sky_latlong(elevation, sun_azimuth_deg=90 - elevation, turbidity=4.0)
    write_image(folder / "maps" / f"sun-{elevation:02d}.exr", sky)
(folder / "scene.toml").write_text(SCENE)

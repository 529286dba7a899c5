"""A board, three kinds of pieces, and two scenes of them: make_scenes.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
import trimesh

from relightcli.adapters.images import write_image
from relightcli.core.lights.sky import sky_latlong
from relightcli.scene.shapes import patch

HEAD = """\
format = 1

[objects.board]
mesh = "board.ply"
material = "board"

[materials.board]
diffuse = [0.45, 0.4, 0.35]

[materials.white]
diffuse = [0.75, 0.75, 0.75]

[materials.black]
diffuse = [0.2, 0.2, 0.2]

[environments.sky]
map = "sky.exr"

[cameras.main]
eye = [0, 1.5, 2.4]
target = [0, 0.15, 0]
fov = 32
size = [120, 90]
"""
PIECE = """
[objects.{colour}_{kind}]
mesh = "{kind}.ply"
material = "{colour}"
motion = "rigid"
translate = [{x}, 0, {z}]
"""
# Radius and height of each piece's outline, from its foot up.
OUTLINES = {
    "pawn": [(0, 0), (0.16, 0), (0.16, 0.05), (0.07, 0.12), (0.06, 0.26), (0.11, 0.3), (0.1, 0.38), (0, 0.42)],
    "rook": [(0, 0), (0.18, 0), (0.18, 0.06), (0.11, 0.14), (0.1, 0.34), (0.15, 0.38), (0.15, 0.46), (0, 0.46)],
    "king": [(0, 0), (0.19, 0), (0.19, 0.06), (0.09, 0.15), (0.08, 0.44), (0.13, 0.56), (0.06, 0.6), (0, 0.68)],
}
SCENES = {
    "duel": [("white", "pawn", -0.5, 0.4), ("black", "rook", 0.4, -0.2)],
    "siege": [("white", "pawn", 0.1, 0.5), ("black", "rook", -0.4, 0.0), ("black", "king", 0.5, -0.4)],
}
HALF, CELLS = 1.5, 32  # of the board
SIDES, STEPS = 14, 20


def piece(outline: list[tuple[float, float]]) -> trimesh.Trimesh:
    """An outline turned about the vertical axis."""
    corners = np.array(outline)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0, length[-1], STEPS)
    radius, height = (np.interp(at, length, corners[:, k]) for k in range(2))
    turn = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)[:, None]
    points = np.stack([radius * np.sin(turn), np.broadcast_to(height, (SIDES, STEPS)), radius * np.cos(turn)], axis=-1)
    return trimesh.Trimesh(*patch(points, wrap_u=True))


folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
for kind, outline in OUTLINES.items():
    piece(outline).export(folder / f"{kind}.ply")
at = np.linspace(-HALF, HALF, CELLS + 1)
z, x = np.meshgrid(at, at, indexing="ij")
trimesh.Trimesh(*patch(np.stack([x, 0 * x, z], axis=-1)), process=False).export(folder / "board.ply")
write_image(folder / "sky.exr", sky_latlong(40.0, overcast=True))
for name, placed in SCENES.items():
    pieces = [PIECE.format(colour=colour, kind=kind, x=x, z=z) for colour, kind, x, z in placed]
    (folder / f"{name}.toml").write_text(HEAD + "".join(pieces))

"""Scenes with a skinned character that is cheap to trace: a jointed bar over a floor, and a sheet."""

from __future__ import annotations

import numpy as np

from relightcli.adapters.images import write_image
from tests.adapters.test_gltf import Builder
from tests.adapters.test_rigs import animate

SCENE = """format = 1
[objects.bar]
mesh = "bar.glb"
material = "red"
motion = "skinned"
translate = [0, 0.1, 0]
[objects.floor]
mesh = "floor.obj"
material = "grey"
[materials.grey]
[materials.red]
diffuse = [0.7, 0.3, 0.2]
[environments.sky]
map = "sky.exr"
[cameras.main]
eye = [0.5, 1.5, 5]
target = [0, 1, 0]
size = [20, 16]
"""
SIDES = 4  # of the bar
COLUMNS, ROWS = 7, 13  # of the sheet's vertices


def bar(path):
    """A square bar from y = 0 to 2 with a joint in its middle, and clips `bend` (0 to 2 s) and `still` (one frame)."""
    corner = 0.25 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    heights = np.linspace(0, 2, 5)
    points, normals, weights, faces = [], [], [], []
    for side in range(SIDES):
        a, b = corner[side], corner[(side + 1) % SIDES]
        out = np.array([b[1] - a[1], 0, a[0] - b[0]])
        for y in heights:
            up = np.clip((y - 0.5) / 1.0, 0, 1)
            for x, z in (a, b):
                points.append((x, y, z))
                normals.append(out / np.linalg.norm(out) * -np.sign(out @ [a[0] + b[0], 0, a[1] + b[1]]) * -1)
                weights.append((1 - up, up, 0, 0))
        first = side * 2 * len(heights)
        for k in range(len(heights) - 1):
            at = first + 2 * k
            faces += [(at, at + 2, at + 1), (at + 1, at + 2, at + 3)]
    return _jointed(path, points, normals, weights, faces, 2, [0, 30, 60, 90, 120])


def sheet(path, degrees=tuple(range(-120, 121, 30))):
    """A sheet of no thickness, 1 wide and from y = 0 to 2, that looks along z, with a joint in its middle; the clip
    `bend` (0 to 4 s) folds it back by 120 degrees at first, and forth by as much in the end."""
    points, normals, weights, faces = [], [], [], []
    for y in np.linspace(0, 2, ROWS):
        up = np.clip((y - 0.5) / 1.0, 0, 1)
        for x in np.linspace(-0.5, 0.5, COLUMNS):
            points.append((x, y, 0))
            normals.append((0, 0, 1))
            weights.append((1 - up, up, 0, 0))
    for row in range(ROWS - 1):
        for column in range(COLUMNS - 1):
            at = row * COLUMNS + column
            faces += [(at, at + 1, at + COLUMNS), (at + 1, at + COLUMNS + 1, at + COLUMNS)]
    return _jointed(path, points, normals, weights, faces, 0, degrees)


def _jointed(path, points, normals, weights, faces, axis, degrees):
    """A mesh whose upper joint, at y = 1, turns about an axis: by the next of some degrees every half second (`bend`),
    by the third of them (`still`)."""
    b = Builder()
    inverse = np.tile(np.eye(4, dtype="<f4").reshape(1, 16), (2, 1))
    inverse[1, 13] = -1
    b.mesh(
        {
            "attributes": {
                "POSITION": b.accessor(np.array(points, "<f4")),
                "NORMAL": b.accessor(np.array(normals, "<f4")),
                "JOINTS_0": b.accessor(np.tile(np.array([[0, 1, 0, 0]], "<u1"), (len(points), 1))),
                "WEIGHTS_0": b.accessor(np.array(weights, "<f4")),
            },
            "indices": b.accessor(np.array(faces, "<u2").reshape(-1)),
        }
    )
    b.node(mesh=0, skin=0)
    b.node(name="low", children=[2])
    b.node(name="high", translation=[0, 1, 0])
    b.header["skins"] = [{"joints": [1, 2], "inverseBindMatrices": b.accessor(inverse, type="MAT4")}]
    half = 0.5 * np.radians(degrees)
    turns = np.zeros((len(half), 4))
    turns[:, axis], turns[:, 3] = np.sin(half), np.cos(half)
    animate(b, "rotation", 0.5 * np.arange(len(turns)), turns, name="bend")
    animate(b, "rotation", [0], turns[2:3], name="still")
    return b.glb(path)


def pose_scene(folder, text=SCENE):
    """Writes the scene; returns the path of its file."""
    folder.mkdir(parents=True, exist_ok=True)
    bar(folder / "bar.glb")
    (folder / "floor.obj").write_text("v -3 0 -3\nv -3 0 3\nv 3 0 3\nv 3 0 -3\nf 1 2 3\nf 1 3 4\n")
    sky = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky[:4] += 1
    write_image(folder / "sky.exr", sky)
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"

"""Ten small scenes and their skies for the promise of --tolerance: of none of them did any choice know anything.

A scene has three cameras that settings are chosen with (`plan.pilot` looks through no more), and a fourth, `judge`,
that errors are measured with; every second sky is looked at after an edit of what is adjustable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.bounce_scenes import BounceScene, bleeding, glossy_floor, moved, textures, wall, write
from benchmarks.scenes import shared_data
from relightcli.scene.shapes import Mesh, lathe, rounded, torus_knot, tube

JUDGE = "judge"
EYE, TARGET = (0.0, 1.4, 3.6), (0.0, 0.4, 0.0)
LAMP = """[lights.lamp]
shape = "sphere"
center = [0.2, 1.5, 0.3]
radius = 0.12
radiance = [30, 26, 20]"""


def _simple(
    name: str, about: str, parts: dict[str, tuple[Mesh, str]], edit: tuple[str, ...], glossy: bool = False
) -> BounceScene:
    """parts: name to mesh and TOML of its material."""
    objects = {part: (mesh, part) for part, (mesh, _) in parts.items()}
    return BounceScene(name, about, objects, {p: text for p, (_, text) in parts.items()}, edit, EYE, TARGET, 40, glossy)


def _ground(cells: int, half: float = 1.6) -> Mesh:
    return wall((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), 2 * cells)


def _knot() -> Mesh:
    return moved(tube(torus_knot(2, 3, 0.42, 0.18, 120), 0.11, 14), (0, 0.62, 0))


def ball(cells: int) -> BounceScene:
    mesh = moved(rounded((1.0, 1.0, 1.0), power=2), (0, 0, 0))
    return _simple("ball", "one convex body", {"ball": (mesh, "diffuse = [0.6, 0.5, 0.4]")}, ())


def box(cells: int) -> BounceScene:
    return replace(bleeding(cells), name="box")


def matte(cells: int) -> BounceScene:
    clay, grey = "diffuse = [0.7, 0.5, 0.4]\nadjustable = true", "diffuse = [0.5, 0.5, 0.5]"
    edit = ("knot.diffuse=0.3,0.5,0.7",)
    return _simple("matte", "a knot over the ground", {"knot": (_knot(), clay), "ground": (_ground(cells), grey)}, edit)


def mirror(cells: int) -> BounceScene:
    metal = 'model = "cook-torrance"\ndiffuse = [0, 0, 0]\nspecular = [0.9, 0.8, 0.6]\nf0 = 0.9\nroughness = 0.1'
    parts = {"knot": (_knot(), metal), "slab": (moved(rounded((1.4, 0.12, 1.4), power=8), (0, 0, 0)), metal)}
    return _simple("mirror", "metal, nearly a mirror, and nothing else", parts, (), glossy=True)


def fixed(cells: int) -> BounceScene:
    plastic = 'model = "blinn-phong"\ndiffuse = [0.2, 0.3, 0.5]\nspecular = [0.15, 0.15, 0.15]\nshininess = 40'
    parts = {
        "vase": (lathe([(0.25, 0.0), (0.45, 0.3), (0.4, 0.6), (0.15, 0.9), (0.25, 1.1)], 64), plastic),
        "ground": (_ground(cells), "diffuse = [0.45, 0.4, 0.35]"),
    }
    return _simple("fixed", "a vase, and nothing may be changed", parts, ())


def glossy(cells: int) -> BounceScene:
    return replace(glossy_floor(cells), name="glossy")


def lamp(cells: int) -> BounceScene:
    return replace(bleeding(cells), name="lamp", about="an open box with a lamp in it", more=LAMP)


def textured(cells: int) -> BounceScene:
    return replace(textures(cells), name="textured")


def pillars(cells: int) -> BounceScene:
    stone, grey = "diffuse = [0.6, 0.57, 0.5]\nadjustable = true", "diffuse = [0.4, 0.4, 0.42]"
    profile = [(0.16, 0.0), (0.11, 0.08), (0.1, 0.5), (0.1, 0.9), (0.16, 1.0)]
    parts: dict[str, tuple[Mesh, str]] = {"ground": (_ground(cells), grey)}
    for k in range(6):
        angle = math.pi * k / 3
        mesh = moved(lathe(profile, 24), (0.8 * math.cos(angle), 0, 0.8 * math.sin(angle)))
        parts[f"pillar{k}"] = (mesh, stone)
    edit = tuple(f"pillar{k}.diffuse=0.7,0.3,0.2" for k in range(6))
    return _simple("pillars", "six pillars on the ground", parts, edit)


def bunny(cells: int) -> BounceScene | None:
    """Of the test data."""
    data = shared_data()
    path = None if data is None else data / "meshes" / "stanford" / "bunny_lowres.ply"
    if path is None or not path.exists():
        return None
    import trimesh

    mesh = trimesh.load(path, force="mesh", process=False)
    points = np.asarray(mesh.vertices, float)
    scale = 1.1 / np.ptp(points[:, 1])
    points = (points - [points[:, 0].mean(), points[:, 1].min(), points[:, 2].mean()]) * scale
    parts = {
        "bunny": ((points, np.asarray(mesh.faces)), "diffuse = [0.65, 0.55, 0.45]\nadjustable = true"),
        "ground": (_ground(cells), "diffuse = [0.35, 0.45, 0.3]"),
    }
    return _simple("bunny", "the Stanford bunny on the ground", parts, ("bunny.diffuse=0.2,0.4,0.6",))


MAKERS: tuple[Callable[[int], BounceScene | None], ...] = (
    ball,
    box,
    matte,
    mirror,
    fixed,
    glossy,
    lamp,
    textured,
    pillars,
    bunny,
)


def write_scene(scene: BounceScene, folder: Path, size: tuple[int, int]) -> Path:
    """The scene's file, with two more cameras to choose with, and `judge`."""
    turned = ((JUDGE, 24.0, 1.25), ("left", 50.0, 1.0), ("right", -50.0, 1.0))
    if scene.name in ("box", "lamp"):  # open at the front only
        turned = ((JUDGE, 11.0, 1.1), ("left", 20.0, 1.0), ("right", -20.0, 1.0))
    cameras = []
    # `judge` last: the pilot takes the first three.
    for name, degrees, lift in (*turned[1:], turned[0]):
        x, y, z = np.subtract(scene.eye, scene.target)
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        eye = np.add(scene.target, (c * x + s * z, lift * y, c * z - s * x))
        cameras.append(
            f"[cameras.{name}]\neye = {[float(e) for e in eye]}\ntarget = {list(scene.target)}\nfov = {scene.fov}\n"
            f"size = {list(size)}"
        )
    return write(replace(scene, more="\n".join([*cameras, scene.more])), folder, size)


def judging_skies() -> dict[str, NDArray[np.float32]]:
    """Five skies that nothing was chosen by."""
    from relightcli.core.lights.sky import sky_latlong

    height, width = 128, 256
    latitude = math.pi * (0.5 - (np.arange(height) + 0.5) / height)
    longitude = math.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    even = 1.0 + 0.3 * np.cos(latitude)[:, None] * np.sin(longitude) + 0.2 * np.sin(latitude)[:, None]
    band = np.exp(-((latitude / 0.2) ** 2))[:, None, None]
    warm = (0.5 + 0.5 * np.cos(longitude - 0.7))[None, :, None]
    colours = band * (warm * np.array([3.0, 1.2, 0.3]) + (1 - warm) * np.array([0.2, 0.5, 2.5]))
    studio = np.full((height, width, 3), 0.02)
    # Row, column, height, width of a soft box, and its radiance.
    for row, column, tall, wide, radiance in ((22, 40, 20, 26, 12.0), (40, 150, 30, 20, 3.0), (50, 215, 12, 6, 20.0)):
        studio[row : row + tall, column : column + wide] = radiance
    return {
        "even": np.repeat(even[..., None], 3, axis=2).astype(np.float32),
        "low sun": sky_latlong(13.0, 200.0, size=(height, width)),
        "high sun": sky_latlong(68.0, 20.0, size=(height, width)),
        "band": (0.05 + colours).astype(np.float32),
        "studio": studio.astype(np.float32),
    }

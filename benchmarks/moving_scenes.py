"""Scenes in which things move after the simulation, each with places to put them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import bounce_scenes
from benchmarks.bounce_scenes import EYE, TARGET, BounceScene, moved, wall
from benchmarks.scenes import shared_data
from relightcli.scene.shapes import Mesh, rounded

GREY, CLAY = "diffuse = [0.6, 0.6, 0.6]", "diffuse = [0.7, 0.5, 0.4]"
LAMP = '[lights.lamp]\nshape = "sphere"\ncenter = [2, 3, 0]\nradius = 0.3\nradiance = [30, 30, 30]\n'
PANEL = (
    '[lights.panel]\nshape = "rectangle"\ncenter = [0, 1.95, -0.4]\nedge_u = [0.7, 0, 0]\nedge_v = [0, 0, 0.5]\n'
    "radiance = [8, 8, 8]\n"
)


@dataclass
class MovingScene:
    """scene; at: where the scene file has every mover; places: what `--move` takes for each picture; even: under an
    even sky, else one that is brighter above and on one side; coarse: meshes that want more vertices."""

    scene: BounceScene
    at: dict[str, tuple[float, float, float]]
    places: list[tuple[str, ...]]
    even: bool = False
    coarse: bool = False


def write(made: MovingScene, folder: Path, size: tuple[int, int]) -> Path:
    """Writes the scene with what moves; returns the scene file."""
    path = bounce_scenes.write(made.scene, folder, size)
    text = path.read_text()
    for name, place in made.at.items():
        mesh = f'mesh = "{name}.obj"'
        text = text.replace(mesh, f'{mesh}\nmotion = "rigid"\ntranslate = {list(map(float, place))}')
    path.write_text(text)
    return path


def _centered(mesh: Mesh) -> Mesh:
    corners = mesh[0]
    return corners - 0.5 * (corners.min(0) + corners.max(0)), mesh[1]


def _ball(detail: int) -> Mesh:
    return _centered(rounded((1.0, 1.0, 1.0), power=2, subdivisions=detail))


def _floor(cells: int, half: float = 3.0) -> Mesh:
    return wall((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), cells)


def ball(cells: int, detail: int) -> MovingScene:
    """A ball over a plane at several heights."""
    objects = {"floor": (_floor(2 * cells), "grey"), "ball": (_ball(detail), "clay")}
    scene = BounceScene(
        "ball", "a ball over a plane", objects, {"grey": GREY, "clay": CLAY}, (), (0, 2.5, 4.5), (0, 0.6, 0)
    )
    return MovingScene(scene, {"ball": (0, 0.6, 0)}, [(f"ball=0,{h},0",) for h in (0.5, 0.6, 0.8, 1.2, 2.0)])


def lamp(cells: int, detail: int) -> MovingScene:
    """The ball and a lamp, both elsewhere."""
    made = ball(cells, detail)
    made.scene.name, made.scene.about, made.scene.more = "lamp", "a lamp that moves over a ball", LAMP
    made.places = [("lamp=-1,3,1", "ball=0,0.7,0"), ("lamp=1.5,2,1.5", "ball=-0.5,1,0"), ("lamp=0,3,0",)]
    made.even = True
    return made


def bar(cells: int, detail: int) -> MovingScene:
    """A bar over a floor, with a lamp between them beside its end: light differs along it, and from below."""
    mesh = _centered(rounded((1.6, 0.3, 0.3), power=8, subdivisions=detail))
    objects = {"floor": (_floor(2 * cells, 2.0), "grey"), "bar": (mesh, "clay")}
    small = LAMP.replace("radius = 0.3", "radius = 0.15").replace("30, 30, 30", "60, 60, 60")
    about = "a bar with a lamp beside its end"
    materials = {"grey": GREY, "clay": CLAY}
    scene = BounceScene("bar", about, objects, materials, (), (0, 2.0, 3.6), (0, 0.5, 0), more=small)
    return MovingScene(scene, {"bar": (0, 0.9, 0)}, [("lamp=0.8,0.45,0", "bar=0,0.9,0")])


def room(cells: int, detail: int) -> MovingScene:
    """An open box with coloured walls, a panel of light and two blocks that are moved."""
    walls = bounce_scenes._room(cells)
    objects = {name: (mesh, {"left": "red", "right": "green"}.get(name, "white")) for name, mesh in walls.items()}
    objects["tall"] = (_centered(rounded((0.5, 0.9, 0.5), power=8, subdivisions=detail)), "white")
    objects["short"] = (_centered(rounded((0.5, 0.5, 0.5), power=8, subdivisions=detail)), "white")
    materials = {
        "white": "diffuse = [0.75, 0.75, 0.75]",
        "red": "diffuse = [0.7, 0.06, 0.05]",
        "green": "diffuse = [0.1, 0.5, 0.1]",
    }
    scene = BounceScene("room", "an open box with two blocks", objects, materials, (), EYE, TARGET, more=PANEL)
    places = [
        ("tall=-0.35,0.46,-0.3,0,15,0", "short=0.35,0.26,0.1,0,-20,0"),
        ("tall=0.4,0.46,-0.4,0,40,0", "short=-0.3,0.26,0.3"),
        ("tall=0,0.6,-0.2,0,0,90", "short=0.1,1.3,0,20,30,0"),
    ]
    return MovingScene(scene, {"tall": (-0.35, 0.46, -0.3), "short": (0.35, 0.26, 0.1)}, places)


def bricks(cells: int, detail: int) -> MovingScene:
    """Ten bricks on a floor, in heaps and in the air."""
    objects: dict[str, tuple[Mesh, str]] = {"floor": (_floor(2 * cells, 2.5), "grey")}
    at = {}
    brick = _centered(rounded((0.8, 0.35, 0.4), power=8, subdivisions=detail - 1))
    rng = np.random.default_rng(3)
    places = []
    for k in range(10):
        objects[f"brick{k}"] = (brick, ("clay", "blue")[k % 2])
        at[f"brick{k}"] = (-1.6 + 0.8 * (k % 5), 0.18, -0.5 + 1.0 * (k // 5))
    for high in (0.0, 0.5):
        moves = []
        for k in range(10):
            x, _, z = np.array(at[f"brick{k}"]) + rng.uniform(-0.08, 0.08, 3)
            y = 0.18 + high * (0.2 + rng.random())
            moves.append(f"brick{k}={x:.3f},{y:.3f},{z:.3f},0,{rng.uniform(0, 360):.1f},0")
        places.append(tuple(moves))
    materials = {"grey": GREY, "clay": CLAY, "blue": "diffuse = [0.2, 0.3, 0.6]"}
    scene = BounceScene("bricks", "ten bricks", objects, materials, (), (0, 3.0, 4.2), (0, 0.2, 0))
    return MovingScene(scene, at, places)


def chess(cells: int, detail: int) -> MovingScene | None:
    """Chess pieces moved on a board."""
    data = shared_data()
    if data is None:
        return None
    import trimesh

    objects: dict[str, tuple[Mesh, str]] = {"board": (_floor(2 * cells, 2.5), "grey")}
    at = {}
    spots = {"king": (0.5, 0.5), "knight": (-1.5, 0.5), "pawn": (1.5, -0.5)}
    for name in spots:
        mesh = trimesh.load(data / "meshes" / "chess" / f"{name}.obj", force="mesh", process=False)
        objects[name] = (moved((np.asarray(mesh.vertices), np.asarray(mesh.faces)), (0, 0, 0), 0, 0.42), "clay")
        at[name] = (spots[name][0], 0.0, spots[name][1])
    scene = BounceScene("chess", "chess pieces", objects, {"grey": GREY, "clay": CLAY}, (), (0, 2.4, 4.2), (0, 0.5, 0))
    places = [
        ("king=-0.5,0,0.5", "knight=0.5,0,-0.5,0,90,0", "pawn=0.5,0,0.5"),
        ("king=1.5,0,0.5", "knight=-0.5,0.4,1.5,0,30,0", "pawn=-0.5,0,-0.5"),
    ]
    return MovingScene(scene, at, places, coarse=True)


def edited(cells: int, detail: int) -> MovingScene:
    """Two glossy movers and a matte one, whose materials are all changed after the simulation."""
    objects: dict[str, tuple[Mesh, str]] = {
        "floor": (_floor(2 * cells), "grey"),
        "ball": (_ball(detail), "brass"),
        "block": (_centered(rounded((0.9, 0.9, 0.9), power=8, subdivisions=detail)), "lacquer"),
        "egg": (_centered(rounded((0.6, 0.8, 0.6), power=2, subdivisions=detail)), "paint"),
    }
    metal = 'model = "cook-torrance"\ndiffuse = {}\nspecular = {}\nf0 = {}\nroughness = {}\nadjustable = true'
    materials = {
        "grey": GREY,
        "brass": metal.format("[0.1, 0.1, 0.1]", "[0.8, 0.7, 0.5]", 0.6, 0.2),
        "lacquer": metal.format("[0.6, 0.5, 0.4]", "[0.1, 0.1, 0.1]", 0.2, 0.6),
        "paint": "diffuse = [0.7, 0.2, 0.2]\nadjustable = true",
    }
    edit = (
        *("brass.diffuse=0.6,0.2,0.1", "brass.specular=0.1,0.1,0.1", "brass.f0=0.3", "brass.roughness=0.5"),
        *("lacquer.diffuse=0.05,0.05,0.05", "lacquer.specular=0.9,0.8,0.6", "lacquer.f0=0.8", "lacquer.roughness=0.4"),
        "paint.diffuse=0.1,0.3,0.8",
    )
    about = "three movers, all of their materials changed"
    scene = BounceScene("edited", about, objects, materials, edit, (0, 2.5, 4.5), (0, 0.5, 0))
    at = {"ball": (0.0, 0.6, 0.5), "block": (-1.2, 0.5, 0.0), "egg": (1.2, 0.45, 0.0)}
    places = [
        ("ball=0.1,0.52,0.4", "block=-0.85,0.46,0,0,20,0", "egg=0.3,0.42,-0.45"),
        ("ball=0,0.7,0", "block=0.9,0.8,0.3,30,20,0", "egg=-0.75,0.42,0.2,0,0,40"),
    ]
    return MovingScene(scene, at, places)


MAKERS: tuple[Callable[[int, int], MovingScene | None], ...] = (ball, lamp, room, bricks, chess, edited)

"""Scenes in which light bounces, each with an edit of its materials that is made after the simulation.

All are made here; the chess set alone needs the test data (../shared/data).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.scenes import shared_data
from relightcli.scene.shapes import Mesh, join, patch, rounded, torus_knot, tube


@dataclass
class BounceScene:
    """name; objects: name to (mesh, material); materials: name to TOML lines; the edit as `--set` takes it; glossy: is
    judged as such."""

    name: str
    about: str
    objects: dict[str, tuple[Mesh, str]]
    materials: dict[str, str]
    edit: tuple[str, ...]
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 40.0
    glossy: bool = False
    texture: str = ""
    more: str = ""
    textured: set[str] = field(default_factory=set)


def write(scene: BounceScene, folder: Path, size: tuple[int, int]) -> Path:
    """Writes the scene file and its meshes; returns the scene file."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["format = 1"]
    for name, (mesh, material) in scene.objects.items():
        _write_obj(folder / f"{name}.obj", mesh, name in scene.textured)
        lines += [f"[objects.{name}]", f'mesh = "{name}.obj"', f'material = "{material}"']
    for name, text in scene.materials.items():
        lines += [f"[materials.{name}]", text]
    if scene.textured:
        _write_texture(folder / "tiles.png")
    lines += ["[cameras.main]", f"eye = {list(scene.eye)}", f"target = {list(scene.target)}"]
    lines += [f"fov = {scene.fov}", f"size = {list(size)}", scene.more]
    path = folder / "scene.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def _write_obj(path: Path, mesh: Mesh, textured: bool) -> None:
    positions, faces = mesh
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in positions]
    if textured:
        low, extent = positions.min(0), np.maximum(np.ptp(positions, axis=0), 1e-9)
        uv = (positions - low) / extent
        # A wall or a floor: its two long axes.
        a, b = np.argsort(np.ptp(positions, axis=0))[1:]
        lines += [f"vt {p:.6g} {q:.6g}" for p, q in uv[:, [a, b]]]
        lines += [f"f {i}/{i} {j}/{j} {k}/{k}" for i, j, k in faces + 1]
    else:
        lines += [f"f {i} {j} {k}" for i, j, k in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def _write_texture(path: Path) -> None:
    from relightcli.adapters.images import write_image

    row, column = np.indices((256, 256)) // 32
    dark = ((row + column) % 2)[..., None]
    colours = np.where(dark, (0.75, 0.2, 0.12), (0.85, 0.8, 0.7))
    write_image(path, colours.astype(np.float32))


def wall(corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], cells: int) -> Mesh:
    """A parallelogram of cells x cells, which looks along u x v."""
    t = np.linspace(0, 1, cells + 1)
    points = np.array(corner) + t[:, None, None] * np.array(u) + t[None, :, None] * np.array(v)
    return patch(points)


def moved(mesh: Mesh, by: tuple[float, float, float], turn: float = 0.0, scale: float = 1.0) -> Mesh:
    """The mesh scaled, turned about +Y by `turn` degrees, then moved."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return scale * mesh[0] @ rotation.T + np.array(by), mesh[1]


def _room(cells: int) -> dict[str, Mesh]:
    """A box 2 wide, 2 high, 2 deep, open at the front (+Z) and above its front half."""
    return {
        "floor": wall((-1, 0, 1), (2, 0, 0), (0, 0, -2), cells),
        "left": wall((-1, 0, 1), (0, 0, -2), (0, 2, 0), cells),
        "right": wall((1, 0, -1), (0, 0, 2), (0, 2, 0), cells),
        "back": wall((-1, 0, -1), (2, 0, 0), (0, 2, 0), cells),
        "roof": wall((-1, 2, -1), (2, 0, 0), (0, 0, 1), cells),
    }


def _ball(radius: float, at: tuple[float, float, float], subdivisions: int = 4) -> Mesh:
    mesh = rounded((2 * radius,) * 3, power=2, subdivisions=subdivisions)
    return moved(mesh, (at[0], at[1] - radius, at[2]))


EYE, TARGET = (0.0, 1.15, 4.3), (0.0, 0.85, 0.0)


def bleeding(cells: int) -> BounceScene:
    room = _room(cells)
    objects = {name: (mesh, {"left": "red", "right": "green"}.get(name, "white")) for name, mesh in room.items()}
    objects["ball"] = (_ball(0.4, (-0.35, 0.4, -0.2)), "white")
    objects["block"] = (moved(rounded((0.5, 0.9, 0.5), power=8), (0.4, 0, -0.35), 20), "white")
    materials = {
        "white": "diffuse = [0.75, 0.75, 0.75]\nadjustable = true",
        "red": "diffuse = [0.7, 0.06, 0.05]\nadjustable = true",
        "green": "diffuse = [0.1, 0.5, 0.1]",
    }
    return BounceScene(
        "bleeding",
        "open box, red wall made blue",
        objects,
        materials,
        ("red.diffuse=0.05,0.1,0.75", "white.diffuse=0.8,0.78,0.7"),
        EYE,
        TARGET,
    )


def glossy_floor(cells: int) -> BounceScene:
    floor = wall((-2, 0, 2), (4, 0, 0), (0, 0, -4), 2 * cells)
    objects = {
        "floor": (floor, "lacquer"),
        "wall": (wall((-2, 0, -1.2), (4, 0, 0), (0, 1.6, 0), cells), "cream"),
        "ball": (_ball(0.45, (-0.7, 0.46, -0.2)), "orange"),
        "block": (moved(rounded((0.6, 0.8, 0.6), power=8), (0.6, 0.01, -0.2), 30), "blue"),
    }
    materials = {
        "lacquer": 'model = "cook-torrance"\ndiffuse = [0.15, 0.15, 0.15]\nspecular = [0.8, 0.8, 0.8]\nf0 = 0.3\n'
        "roughness = 0.15\nadjustable = true",
        "cream": "diffuse = [0.7, 0.65, 0.5]",
        "orange": "diffuse = [0.8, 0.35, 0.05]\nadjustable = true",
        "blue": 'model = "blinn-phong"\ndiffuse = [0.1, 0.15, 0.5]\nspecular = [0.2, 0.2, 0.2]\nshininess = 60',
    }
    return BounceScene(
        "glossy floor",
        "lacquered floor made rougher, more reflective",
        objects,
        materials,
        ("lacquer.roughness=0.25", "lacquer.f0=0.6"),
        (0.0, 1.2, 3.6),
        (0.0, 0.35, 0.0),
        glossy=True,
    )


def caustic(cells: int) -> BounceScene:
    # A third of a cylinder, upright, whose hollow side throws the sun on the ground and on the wall beside it.
    angle = np.linspace(math.radians(200), math.radians(340), 2 * cells + 1)
    height = np.linspace(0.0, 0.5, cells // 2 + 1)
    points = np.stack(
        np.broadcast_arrays(0.7 * np.cos(angle)[:, None], height[None, :], 0.7 * np.sin(angle)[:, None]), axis=-1
    )
    inner = patch(points[::-1].copy())
    objects = {
        "floor": (wall((-2, 0, 2), (4, 0, 0), (0, 0, -4), 2 * cells), "plaster"),
        "wall": (wall((-1.1, 0, 1.0), (0, 0, -2.2), (0, 1.2, 0), cells), "plaster"),
        "arc": (inner, "metal"),
    }
    materials = {
        "plaster": "diffuse = [0.6, 0.6, 0.6]",
        "metal": 'model = "cook-torrance"\ndiffuse = [0, 0, 0]\nspecular = [0.95, 0.8, 0.5]\nf0 = 0.9\n'
        "roughness = 0.2\nadjustable = true",
    }
    return BounceScene(
        "caustic",
        "hollow metal arc by a wall in the sun, made rougher and redder",
        objects,
        materials,
        ("metal.roughness=0.3", "metal.specular=0.95,0.5,0.35"),
        (0.6, 1.9, 2.6),
        (-0.1, 0.15, -0.1),
        glossy=True,
        more="[objects.arc]\n" if False else "",
    )


def twelve(cells: int) -> BounceScene:
    objects: dict[str, tuple[Mesh, str]] = {}
    shades = {"floor": "m0", "left": "m1", "right": "m2", "back": "m3", "roof": "m0"}
    for name, mesh in _room(cells).items():
        objects[name] = (mesh, shades[name])
    rng = np.random.default_rng(3)
    materials = {}
    for k in range(12):
        colour = ", ".join(f"{c:.2f}" for c in rng.uniform(0.15, 0.8, 3))
        text = f"diffuse = [{colour}]\nadjustable = {'true' if k % 3 == 0 else 'false'}"
        if k >= 4 and k % 2 == 0:
            text += f'\nmodel = "blinn-phong"\nspecular = [0.15, 0.15, 0.15]\nshininess = {20 + 10 * k}'
        if k in (5, 9):
            text += '\nmodel = "cook-torrance"\nspecular = [0.3, 0.3, 0.3]\nf0 = 0.5\nroughness = 0.3'
        materials[f"m{k}"] = text
    for k in range(8):
        at = (-0.72 + 0.48 * (k % 4), 0.2, -0.6 + 0.75 * (k // 4))
        shape = (
            _ball(0.2, at, 3)
            if k % 2
            else moved(rounded((0.36, 0.4, 0.36), power=6, subdivisions=3), (at[0], 0, at[2]))
        )
        objects[f"thing{k}"] = (shape, f"m{k + 4}")
    return BounceScene(
        "twelve materials",
        "open box with twelve materials, four of them changed",
        objects,
        materials,
        ("m0.diffuse=0.7,0.6,0.3", "m3.diffuse=0.15,0.3,0.7", "m6.diffuse=0.7,0.1,0.1", "m9.roughness=0.5"),
        EYE,
        TARGET,
    )


def textures(cells: int) -> BounceScene:
    objects = {
        "floor": (wall((-1.5, 0, 1.5), (3, 0, 0), (0, 0, -3), 2 * cells), "tiles"),
        "wall": (wall((-1.5, 0, -0.9), (3, 0, 0), (0, 1.8, 0), cells), "paper"),
        "ball": (_ball(0.45, (-0.45, 0.46, 0.0)), "white"),
        "knot": (moved(tube(torus_knot(2, 3, 0.3, 0.13, 180), 0.08, 16), (0.65, 0.5, 0.1)), "white"),
    }
    materials = {
        "tiles": 'diffuse = [1, 1, 1]\ndiffuse_texture = "tiles.png"\nadjustable = true',
        "paper": 'diffuse = [0.8, 0.8, 0.8]\ndiffuse_texture = "tiles.png"',
        "white": "diffuse = [0.8, 0.8, 0.8]\nadjustable = true",
    }
    return BounceScene(
        "textures",
        "textured floor and wall, tinted",
        objects,
        materials,
        ("tiles.diffuse=0.6,0.9,0.6", "white.diffuse=0.7,0.7,0.8"),
        (0.0, 1.2, 3.4),
        (0.0, 0.5, 0.0),
        textured={"floor", "wall"},
    )


def chess(cells: int) -> BounceScene | None:
    data = shared_data()
    if data is None:
        return None
    import trimesh

    pieces: dict[str, list[Mesh]] = {"white": [], "black": []}
    order = ("rook", "knight", "bishop", "queen", "king", "bishop", "knight", "rook")
    loaded = {}
    for kind in {*order, "pawn"}:
        mesh = trimesh.load(data / "meshes" / "chess" / f"{kind}.obj", force="mesh", process=False)
        loaded[kind] = (np.asarray(mesh.vertices), np.asarray(mesh.faces))
    for side, back, front, turn in (("white", 3.5, 2.5, 180.0), ("black", -3.5, -2.5, 0.0)):
        for column in range(2, 6):
            x = column - 3.5
            pieces[side].append(moved(loaded[order[column]], (x, 0, back), turn, 0.42))
            pieces[side].append(
                moved(loaded["pawn"], (x, 0, front if column != 4 else front - 2 * np.sign(front)), 0, 0.42)
            )
    squares: dict[str, list[Mesh]] = {"light": [], "dark": []}
    per = max(2, cells // 4)
    for i in range(8):
        for j in range(8):
            squares["light" if (i + j) % 2 else "dark"].append(wall((i - 4, 0, j - 3), (1, 0, 0), (0, 0, -1), per))
    objects = {
        "light": (join(squares["light"]), "maple"),
        "dark": (join(squares["dark"]), "walnut"),
        "white": (join(pieces["white"]), "white"),
        "black": (join(pieces["black"]), "black"),
    }
    shine = 'model = "cook-torrance"\nf0 = 0.25\nroughness = 0.3\nadjustable = true\n'
    materials = {
        "maple": "diffuse = [0.6, 0.5, 0.35]",
        "walnut": "diffuse = [0.15, 0.09, 0.05]",
        "white": shine + "diffuse = [0.6, 0.55, 0.45]\nspecular = [0.3, 0.3, 0.3]",
        "black": shine + "diffuse = [0.05, 0.05, 0.05]\nspecular = [0.3, 0.3, 0.3]",
    }
    return BounceScene(
        "chess",
        "both sides of a chess set recast: gold against copper",
        objects,
        materials,
        (
            "white.diffuse=0.1,0.07,0.02",
            "white.specular=0.9,0.7,0.3",
            "white.f0=0.8",
            "black.diffuse=0.1,0.04,0.02",
            "black.specular=0.9,0.45,0.3",
            "black.f0=0.8",
            "black.roughness=0.4",
        ),
        (0.0, 5.0, 8.0),
        (0.0, 0.4, 0.6),
        fov=36.0,
        glossy=True,
    )


MAKERS: tuple[Callable[[int], BounceScene | None], ...] = (bleeding, glossy_floor, caustic, chess, twelve, textures)

"""What is measured: one object on a ground, skies, and the store made of them.

The Stanford bunny and Poly Haven skies are used where the test data has them (../shared/data beside the checkout, or
RELIGHT_SHARED_DATA); else a knotted tube of as many vertices and the built-in sky.
"""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.processes import run_tool

BUNNY_VERTICES = 35_947
SCENE = """\
format = 1

[objects.subject]
mesh = "{mesh}"
material = "clay"
{place}

[objects.ground]
mesh = "ground.obj"
material = "grey"

[materials.clay]
diffuse = [0.7, 0.5, 0.4]

[materials.grey]
diffuse = [0.5, 0.5, 0.5]

[cameras.main]
eye = [1.6, 1.7, 3.4]
target = [-0.1, 0.55, 0]
fov = 36
size = [640, 480]

[cameras.square]
eye = [1.6, 1.7, 3.4]
target = [-0.1, 0.55, 0]
fov = 36
size = [{side}, {side}]
"""
GROUND_HALF = 3.0


@dataclass(frozen=True)
class Setting:
    """A folder to work in, and how large to work."""

    work: Path
    quick: bool

    @property
    def store(self) -> Path:
        return self.work / "transfer.zarr"

    @property
    def side(self) -> int:
        """Pixels along the square picture."""
        return 128 if self.quick else 512

    @property
    def options(self) -> tuple[str, ...]:
        """What `precompute` is told: nothing, or to leave a small scene small."""
        return ("--no-subdivide",) if self.quick else ()


def shared_data() -> Path | None:
    """The folder of the test data, None where there is none."""
    given = os.environ.get("RELIGHT_SHARED_DATA")
    folder = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "data"
    return folder if folder.is_dir() else None


def write_scene(setting: Setting, vertices: int | None = None) -> tuple[Path, str]:
    """Writes the scene; returns its file and what the object is. `vertices` asks for a knot of about that many."""
    folder = setting.work / f"scene-{vertices or 'main'}"
    folder.mkdir(parents=True, exist_ok=True)
    _write_ground(folder / "ground.obj", 20 if setting.quick else 1)
    data = shared_data()
    bunny = None if data is None else data / "meshes" / "stanford" / "bunny_zipper_full.ply"
    if vertices is None and not setting.quick and bunny is not None and bunny.exists():
        shutil.copy(bunny, folder / "bunny.ply")
        mesh, place, name = "bunny.ply", "scale = 8\ntranslate = [0.13, -0.264, 0]", "Stanford bunny"
    else:
        count = vertices or (1_500 if setting.quick else BUNNY_VERTICES)
        count = _write_knot(folder / "knot.ply", count)
        mesh, place, name = "knot.ply", "", f"knot of {count:,} vertices"
    scene = folder / "scene.toml"
    scene.write_text(SCENE.format(mesh=mesh, place=place, side=setting.side))
    return scene, f"{name} on a ground"


def _write_ground(path: Path, cells: int) -> None:
    """A square of cells x cells cells that looks up."""
    x = np.linspace(-GROUND_HALF, GROUND_HALF, cells + 1)
    lines = [f"v {a:.9g} 0 {b:.9g}" for a in x for b in x]
    for i in range(cells):
        for j in range(cells):
            a = i * (cells + 1) + j + 1
            lines += [f"f {a} {a + 1} {a + cells + 2}", f"f {a} {a + cells + 2} {a + cells + 1}"]
    path.write_text("\n".join(lines) + "\n")


def _write_knot(path: Path, vertices: int) -> int:
    """A trefoil that stands on the ground, 1.2 high, as PLY; returns how many vertices it has."""
    import trimesh

    from relightcli.scene.shapes import torus_knot, tube

    # 103 x 349 is the number of the bunny's vertices.
    sides = max(6, round(math.sqrt(vertices * 103 / 349)))
    positions, faces = tube(torus_knot(2, 3, 0.42, 0.18, vertices // sides), 0.11, sides)
    positions = positions * (1.2 / np.ptp(positions[:, 1]))
    positions[:, 1] -= positions[:, 1].min()
    trimesh.Trimesh(positions, faces, process=False).export(path)
    return len(positions)


def main_store(setting: Setting) -> Path:
    """The store of the main scene with default settings; made if need be."""
    if not setting.store.exists():
        scene, _ = write_scene(setting)
        run_tool("precompute", scene, "-o", setting.store, "--bounces", "0", *setting.options)
    return setting.store


def two_skies(setting: Setting) -> dict[str, Path]:
    """A smooth sky and one with a small sun."""
    data = shared_data()
    if data is not None and not setting.quick:
        found = {
            "smooth (Poly Haven venice)": data / "envmaps" / "polyhaven_venice_1k.hdr",
            "sun (Poly Haven sunrise)": data / "envmaps" / "polyhaven_sunrise_1k.hdr",
        }
        if all(path.exists() for path in found.values()):
            return found
    from relightcli.adapters.images import write_image
    from relightcli.core.lights.sky import sky_latlong

    skies = {
        "smooth (built-in overcast)": sky_latlong(45.0, overcast=True),
        "sun (built-in clear)": sky_latlong(40.0, 60.0),
    }
    out = {}
    for name, sky in skies.items():
        out[name] = setting.work / f"{name.split()[0]}.exr"
        write_image(out[name], sky)
    return out


def all_skies(setting: Setting) -> dict[str, Path]:
    """Every sky a picture is tried under."""
    data = shared_data()
    maps = [] if data is None or setting.quick else sorted((data / "envmaps").glob("polyhaven_*.hdr"))
    return {path.stem: path for path in maps} or two_skies(setting)

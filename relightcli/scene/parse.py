"""The scene file: TOML to a validated `Scene`. Everything that can be wrong is refused here, by key and in words."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import compose, is_singular
from relightcli.errors import InputError, SystemFault
from relightcli.scene.fields import Table, describe, did_you_mean
from relightcli.scene.materials import energy_note, material_from_table
from relightcli.scene.model import Camera, MotionName, ObjectSpec, RectangleLight, Scene, SphereLight

FORMAT = 1
MAX_FILE_BYTES = 16 << 20
MAX_SIDE = 16384
_MOTIONS = ("static", "rigid", "skinned")
_SECTIONS = ("format", "objects", "materials", "lights", "environments", "cameras", "accuracy")
# Below this sine two directions count as parallel: float64 leaves a few digits of the vector between them.
_PARALLEL = 1e-9


def load_scene(path: str | Path, *, allow_outside: bool = False) -> Scene:
    """Read and validate a scene file.

    Files it names must exist and, unless `allow_outside`, lie in its own folder or below, symbolic links resolved.
    Raises InputError (file, key, expected, found) for everything that does not fit; SystemFault if the file may not be
    read.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; expected a scene file (TOML).")
    if not path.is_file():
        raise InputError(f"{path}: is not a regular file; expected a scene file (TOML).")
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise InputError(f"{path}: {size:,} bytes; expected at most {MAX_FILE_BYTES:,} for a scene file.")
        content = path.read_bytes()
    except OSError as error:
        raise SystemFault(f"{path}: cannot be opened ({error.strerror}).") from None
    try:
        data = tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected UTF-8 text, found byte {content[error.start]:#04x} at {error.start}."
        ) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not valid TOML: {error}.") from None
    folder = path.absolute().parent

    def resolve(written: str, kind: str) -> Path:
        return _existing_file(folder, written, kind, allow_outside)

    return scene_from_table(Table(str(path), "", data, resolve), path.absolute())


def scene_from_table(root: Table, path: Path) -> Scene:
    """A validated scene from the file's root table; `path` is what the scene remembers as its own place."""
    if "format" not in root.data:
        root.fail("format", f"format = {FORMAT}", "Put it on the first line.")
    if type(root.data["format"]) is not int or root.data["format"] != FORMAT:
        root.fail("format", f"{FORMAT}", "This version reads no other format.")
    root.only(_SECTIONS)
    materials = {name: material_from_table(name, table) for name, table in root.entries("materials")}
    objects = {name: _object(name, table, materials) for name, table in root.entries("objects")}
    if not objects:
        root.fail("objects", "at least one object", "Add [objects.NAME] with mesh and material.")
    accuracy = root.table("accuracy")
    accuracy.only(("tolerance",))
    return Scene(
        path=path,
        objects=objects,
        materials=materials,
        lights={name: _light(name, table) for name, table in root.entries("lights")},
        environments={name: _environment(table) for name, table in root.entries("environments")},
        cameras={name: _camera(name, table) for name, table in root.entries("cameras")},
        tolerance=accuracy.number("tolerance", 0.02, low=0.0, high=1.0, open_low=True),
        notes=tuple(note for note in map(energy_note, materials.values()) if note),
    )


def _existing_file(folder: Path, written: str, kind: str, allow_outside: bool) -> Path:
    try:
        found = folder / written
        real = found.resolve()
        if not allow_outside and not real.is_relative_to(folder.resolve()):
            raise InputError(
                f"expected a file in the scene's own folder or below, found {describe(written)}. "
                "Move it there, or give --allow-outside."
            )
        if not real.exists():
            raise InputError(f"expected {kind}, found {describe(written)}: no such file in {str(folder)!r}.")
        if not real.is_file():
            raise InputError(f"expected {kind}, found {describe(written)}, which is not a regular file.")
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"expected {kind}, found {describe(written)} ({error.strerror}).") from None
    except (ValueError, RuntimeError):  # a zero byte, a loop of links
        raise InputError(f"expected {kind}, found {describe(written)}, which is no usable path.") from None
    return found


def _object(name: str, table: Table, materials: dict[str, Any]) -> ObjectSpec:
    keys = ("mesh", "material", "translate", "rotate", "scale", "transform", "two_sided", "motion")
    table.only((*keys, "motion_files", "joint_map"))
    material = table.string("material")
    if material not in materials:
        known = f"one of {', '.join(materials)}" if materials else "a material, and the file defines none"
        table.fail("material", known, did_you_mean(material, materials).strip() or "Define it under [materials].")
    mesh, motion = table.path("mesh", "a mesh"), table.choice("motion", _MOTIONS, "static")
    if motion == "skinned" and mesh.suffix.lower() not in (".gltf", ".glb"):
        table.fail("motion", f"static or rigid for {mesh.name}", "A skin is read from .gltf and .glb files.")
    return ObjectSpec(
        name=name,
        mesh=mesh,
        material=material,
        transform=_transform(table),
        two_sided=table.boolean("two_sided", False),
        motion=cast(MotionName, motion),
        **_captured(table),
    )


def _captured(table: Table) -> dict[str, Any]:
    """`motion_files` and `joint_map`, which skinned objects may have, both or neither."""
    for key in ("motion_files", "joint_map"):
        if key in table.data and table.data.get("motion") != "skinned":
            table.refuse(key, 'expected it beside motion = "skinned" only.')
    if "motion_files" not in table.data and "joint_map" not in table.data:
        return {}
    written = table.data.get("motion_files")
    if not isinstance(written, list) or not written or not all(isinstance(name, str) and name for name in written):
        table.fail("motion_files", "a list of BVH files")
    files = []
    for name in written:
        try:
            files.append(table.resolve(name, "a BVH file"))
        except InputError as error:
            table.refuse("motion_files", str(error))
    return {"motion_files": tuple(files), "joint_map": table.path("joint_map", "a joint map (TOML)")}


def _transform(table: Table) -> NDArray[np.float64]:
    """The object's (4, 4) matrix: `transform` alone, or scale, rotate, translate in this order."""
    if "transform" in table.data:
        for key in ("translate", "rotate", "scale"):
            if key in table.data:
                table.refuse(key, "expected either `transform` or translate/rotate/scale, found both.")
        matrix = _matrix(table)
        if is_singular(matrix[:3, :3]):
            table.fail("transform", "a matrix that does not flatten the object (non-zero determinant)")
        return matrix
    scale = np.ones(3)
    if "scale" in table.data:
        value = table.data["scale"]
        scale = np.array(table.numbers("scale", 3) if isinstance(value, list) else [table.number("scale")] * 3)
        if not scale.all() or is_singular(np.diag(scale)):
            table.fail("scale", "factors other than 0", "A scale of 0 flattens the object.")
    x, y, z, degrees = table.numbers("rotate", 4) if "rotate" in table.data else [0.0, 1.0, 0.0, 0.0]
    if x == y == z == 0.0:
        table.fail("rotate", "[x, y, z, degrees] with an axis that is not 0 0 0")
    translate = np.array(table.vector("translate", (0.0, 0.0, 0.0)))
    return compose(translate, np.array([x, y, z]), degrees, scale)


def _matrix(table: Table) -> NDArray[np.float64]:
    """`transform` as four rows of four numbers, or as sixteen, row by row."""
    value = table.data["transform"]
    flat = value
    if isinstance(value, list) and all(isinstance(row, list) and len(row) == 4 for row in value):
        flat = [number for row in value for number in row]
    row_major = Table(table.file, table.where, {"transform": flat}, table.resolve)
    if not isinstance(flat, list) or len(flat) != 16:
        table.fail("transform", "4 rows of 4 numbers")
    matrix = np.array(row_major.numbers("transform", 16)).reshape(4, 4)
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        advice = "The matrix is row-major: the translation is the last column."
        table.refuse("transform", f"expected a last row of 0 0 0 1, found {matrix[3].tolist()}.", advice)
    return matrix


def _light(name: str, table: Table) -> SphereLight | RectangleLight:
    shape = table.choice("shape", ("sphere", "rectangle"))
    radiance = table.vector("radiance", low=0.0)
    center = table.vector("center")
    if shape == "sphere":
        table.only(
            ("shape", "center", "radius", "radiance"),
            dict.fromkeys(("edge_u", "edge_v"), "a sphere does not use it; it belongs to rectangle."),
        )
        return SphereLight(name, center, table.number("radius", low=0.0, open_low=True), radiance)
    table.only(
        ("shape", "center", "edge_u", "edge_v", "radiance"),
        {"radius": "a rectangle does not use it; it belongs to sphere."},
    )
    edge_u, edge_v = table.vector("edge_u"), table.vector("edge_v")
    for key, edge in (("edge_u", edge_u), ("edge_v", edge_v)):
        if not any(edge):
            table.fail(key, "an edge that is not 0 0 0")
    if _sine(edge_u, edge_v) < _PARALLEL:
        table.fail("edge_v", "an edge that is not parallel to edge_u")
    return RectangleLight(name, center, edge_u, edge_v, radiance)


def _environment(table: Table) -> Path:
    table.only(("map",))
    return table.path("map", "an environment map")


def _camera(name: str, table: Table) -> Camera:
    table.only(("eye", "target", "up", "fov", "size"))
    eye, target = table.vector("eye"), table.vector("target")
    up = table.vector("up", (0.0, 1.0, 0.0))
    view = tuple(t - e for t, e in zip(target, eye, strict=True))
    extent = max(map(abs, (*eye, *target)))
    if not max(map(abs, view)) > 1e-12 * extent:
        table.fail("target", f"a point other than eye {list(eye)}")
    if not any(up):
        table.fail("up", "a direction that is not 0 0 0")
    if _sine(view, up) < _PARALLEL:
        table.refuse("up", f"expected a direction not parallel to the view {list(view)}, found {list(up)}.")
    size = table.data.get("size", [640, 480])
    whole = isinstance(size, list) and len(size) == 2 and all(type(n) is int and 1 <= n <= MAX_SIDE for n in size)
    if not whole:
        table.fail("size", f"[width, height] as whole numbers from 1 to {MAX_SIDE}")
    fov = table.number("fov", 40.0, low=0.0, high=180.0, open_low=True, open_high=True, unit=" degrees")
    return Camera(name, eye, target, up, fov, (size[0], size[1]))


def _sine(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Sine of the angle between two non-zero directions of any length."""
    u, v = (np.array(x) / max(map(abs, x)) for x in (a, b))
    cross = np.cross(u, v)
    return math.sqrt(float(cross @ cross) / (float(u @ u) * float(v @ v)))

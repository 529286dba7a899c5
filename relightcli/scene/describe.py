"""The scene as a JSON object inside a store, so that relighting needs no scene file.

It has the shape of the scene file with every default written out, absolute paths, object transforms as matrices, and
environments with their path relative to the scene's folder as well. Numbers come back exactly.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.errors import InputError, StoreError
from relightcli.scene.fields import Table
from relightcli.scene.materials import table_from_material
from relightcli.scene.model import Geometry, RectangleLight, Scene
from relightcli.scene.parse import FORMAT, scene_from_table

# Geometry refers to objects and materials by position and the first camera is the default, but a store sorts JSON keys.
ORDERED = ("objects", "materials", "lights", "environments", "cameras")


def scene_to_json(scene: Scene, geometry: Geometry | None = None) -> dict[str, Any]:
    """A description of the scene that `json.dumps` takes as it is (finite numbers, lists, strings).

    With `geometry`, also what loading its meshes had to say (`notes`), and which objects got how many vertices and
    faces.
    """
    folder = scene.path.parent
    description: dict[str, Any] = {
        "format": FORMAT,
        "path": str(scene.path),
        "objects": {
            name: {
                "mesh": str(spec.mesh),
                "material": spec.material,
                "transform": spec.transform.tolist(),
                "two_sided": spec.two_sided,
                "motion": spec.motion,
            }
            for name, spec in scene.objects.items()
        },
        "materials": {name: table_from_material(material) for name, material in scene.materials.items()},
        "lights": {name: _light(light) for name, light in scene.lights.items()},
        "environments": {
            name: {"map": str(path), "relative": os.path.relpath(path, folder)}
            for name, path in scene.environments.items()
        },
        "cameras": {
            name: {
                "eye": list(camera.eye),
                "target": list(camera.target),
                "up": list(camera.up),
                "fov": camera.fov,
                "size": list(camera.size),
            }
            for name, camera in scene.cameras.items()
        },
        "accuracy": {"tolerance": scene.tolerance},
    }
    description["order"] = {key: list(description[key]) for key in ORDERED}
    if geometry is not None:
        description["geometry"] = {
            "notes": list(geometry.notes),
            "vertices": _counts(geometry, geometry.vertex_object),
            "faces": _counts(geometry, geometry.face_object),
        }
    return description


def scene_from_json(description: Any, *, folder: Path | None = None) -> Scene:
    """The scene that `scene_to_json` described. Its files need not exist any more.

    An environment that is not at its absolute path is looked for by its relative path in `folder`.
    Raises StoreError for anything that `scene_to_json` cannot have written.
    """
    if not isinstance(description, dict) or not isinstance(description.get("path"), str):
        raise StoreError("its scene description is damaged: expected an object with a path. Precompute it again.")
    data = {key: value for key, value in description.items() if key not in ("path", "geometry", "order")}
    try:
        data |= _in_order(data, description.get("order"))
        environments = Table("scene", "", data, _as_written).entries("environments")
        data["environments"] = {name: {"map": _environment(table, folder)} for name, table in environments}
        return scene_from_table(Table("scene", "", data, _as_written), Path(description["path"]))
    except InputError as error:
        raise StoreError(f"its scene description is damaged: {error} Precompute it again.") from None


def _in_order(data: dict[str, Any], order: Any) -> dict[str, Any]:
    """The ORDERED tables with their names in the scene file's order."""
    tables = {}
    for key in ORDERED:
        table, names = data.get(key), order.get(key) if isinstance(order, dict) else None
        if not isinstance(table, dict) or not isinstance(names, list) or sorted(map(str, names)) != sorted(table):
            raise InputError(f"order.{key}: expected the names of {key}, found {names!r}.")
        tables[key] = {name: table[name] for name in names}
    return tables


def _counts(geometry: Geometry, owner: NDArray[np.int32]) -> dict[str, int]:
    counts = np.bincount(owner, minlength=len(geometry.object_names)).tolist()
    return dict(zip(geometry.object_names, counts, strict=True))


def _as_written(written: str, kind: str) -> Path:
    return Path(written)


def _environment(table: Table, folder: Path | None) -> str:
    absolute, relative = table.string("map"), table.string("relative")
    if folder is not None and not Path(absolute).is_file() and (folder / relative).is_file():
        return str(folder / relative)
    return absolute


def _light(light: Any) -> dict[str, Any]:
    common = {"center": list(light.center), "radiance": list(light.radiance)}
    if isinstance(light, RectangleLight):
        return {"shape": "rectangle", **common, "edge_u": list(light.edge_u), "edge_v": list(light.edge_v)}
    return {"shape": "sphere", **common, "radius": light.radius}

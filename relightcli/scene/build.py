"""A scene's objects as one indexed triangle mesh in world space, with the textures its materials name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import is_mirror, transform_mesh
from relightcli.errors import InputError
from relightcli.scene.describe import scene_from_json, scene_to_json
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.settings import apply_settings

if TYPE_CHECKING:
    from relightcli.adapters.meshes import LoadedMesh
    from relightcli.core.pose.rig import Rig

__all__ = ["apply_settings", "build_geometry", "scene_from_json", "scene_to_json"]


def build_geometry(scene: Scene) -> Geometry:
    """Load every mesh and texture of the scene and put the objects into world space.

    Each object's vertices follow one another in the order of `scene.objects`; its transform acts on positions, the
    inverse transpose on normals, and a mirroring transform turns the faces around, so that fronts stay fronts.
    Skinned objects stand in their rest pose.
    A mesh or texture that is used several times is read once.
    Raises InputError for meshes and textures that cannot be used, and for a texture on a mesh without coordinates.
    """
    from relightcli.adapters.images import read_texture
    from relightcli.adapters.meshes import MAX_COORDINATE, load_mesh
    from relightcli.adapters.rigs import load_rig
    from relightcli.core.pose.rig import posed
    from relightcli.scene.motions import add_motions

    material_index = {name: index for index, name in enumerate(scene.materials)}
    meshes: dict[Path, LoadedMesh] = {}
    loaded_rigs: dict[Path, tuple[LoadedMesh, Rig]] = {}
    rigs: dict[str, Rig] = {}
    textures: dict[int, NDArray[np.float32]] = {}
    pictures: dict[Path, NDArray[np.float32]] = {}
    positions, normals, uvs, faces = [], [], [], []
    notes = list(scene.notes)
    start = 0
    for spec in scene.objects.values():
        if spec.motion == "skinned":
            if spec.mesh not in loaded_rigs:
                loaded_rigs[spec.mesh] = load_rig(spec.mesh)
            mesh, rig = loaded_rigs[spec.mesh]
            rigs[spec.name] = add_motions(rig, spec)
        else:
            if spec.mesh not in meshes:
                meshes[spec.mesh] = load_mesh(spec.mesh)
            mesh = meshes[spec.mesh]
        notes.extend(f"objects.{spec.name}: {spec.mesh.name}: {note}" for note in mesh.notes)
        texture = scene.materials[spec.material].diffuse_texture
        if texture is not None:
            _need_texture_coordinates(scene, spec.name, mesh)
            if texture not in pictures:
                pictures[texture] = read_texture(texture)
            textures[material_index[spec.material]] = pictures[texture]
        with np.errstate(over="ignore", invalid="ignore"):
            if spec.name in rigs:
                moved, turned, _ = posed(rigs[spec.name], spec.transform, None)
                wound = mesh.faces[:, ::-1] if is_mirror(spec.transform[:3, :3]) else mesh.faces
            else:
                moved, turned, wound = transform_mesh(spec.transform, mesh.positions, mesh.normals, mesh.faces)
        if not (np.abs(moved) <= MAX_COORDINATE).all():
            raise InputError(
                f"{scene.path}: objects.{spec.name}: its transform takes the mesh beyond {MAX_COORDINATE:g}; "
                "expected coordinates within. Use a smaller scale or translation."
            )
        positions.append(moved)
        normals.append(turned.astype(np.float32))
        uvs.append(mesh.uvs.astype(np.float32))
        faces.append(wound.astype(np.int64) + start)
        start += len(moved)
    if start > np.iinfo(np.int32).max:
        raise InputError(f"{scene.path}: {start:,} vertices in all; expected at most {np.iinfo(np.int32).max:,}.")

    index = np.arange(len(positions), dtype=np.int32)
    return Geometry(
        object_names=tuple(scene.objects),
        positions=np.concatenate(positions),
        normals=np.concatenate(normals),
        uvs=np.concatenate(uvs),
        faces=np.concatenate(faces).astype(np.int32),
        vertex_object=np.repeat(index, [len(p) for p in positions]),
        face_object=np.repeat(index, [len(f) for f in faces]),
        material=np.array([material_index[spec.material] for spec in scene.objects.values()], dtype=np.int32),
        two_sided=np.array([spec.two_sided for spec in scene.objects.values()], dtype=bool),
        textures=textures,
        notes=tuple(notes),
        rigs=rigs,
    )


def _need_texture_coordinates(scene: Scene, name: str, mesh: LoadedMesh) -> None:
    uvs = mesh.uvs[mesh.faces]
    bare = int((~np.isfinite(uvs).all(axis=(1, 2))).sum())
    if bare:
        spec = scene.objects[name]
        raise InputError(
            f"{scene.path}: objects.{name}.material: {spec.material!r} has a diffuse_texture, but {bare} of "
            f"{len(mesh.faces)} faces of {spec.mesh.name} have no texture coordinates. Use a mesh with UVs, or a "
            "material without texture."
        )

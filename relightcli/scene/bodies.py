"""Rigid objects in frames of their own, so that what is simulated for one holds wherever it is put.

An object's transform is  placement * shape:  shape is the stretch of its polar decomposition brought to volume 1, and
the placement turns, scales and moves. The own frame holds the mesh after its shape; objects that differ in place,
rotation or size alone are the same there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relightcli.core.transport.tessellation import tessellate
from relightcli.scene.build import build_geometry
from relightcli.scene.model import Geometry, Scene
from relightcli.scene.moving import inverse_affine, polar

_DIGITS = 12  # of the shape that are kept: equal shapes come out equal whatever they were turned by
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class OwnMesh:
    """One object: geometry in its own frame; shape (4, 4), file to own frame; placement (4, 4), own frame to world, a
    rotation times a positive number, and a translation."""

    name: str
    geometry: Geometry
    shape: F64
    placement: F64


def own_frame(transform: F64) -> tuple[F64, F64]:
    """(shape, placement), both (4, 4), of an object's transform."""
    _, stretch = polar(transform[:3, :3])
    size = float(np.abs(np.linalg.det(stretch / np.abs(stretch).max())) ** (1.0 / 3.0) * np.abs(stretch).max())
    shape = np.eye(4)
    shape[:3, :3] = np.round(stretch / size, _DIGITS)
    return shape, transform @ inverse_affine(shape)


def own_mesh(scene: Scene, name: str, cut: bool) -> OwnMesh:
    """The object `name` alone; cut: large faces are cut as for any scene of this object."""
    shape, placement = own_frame(scene.objects[name].transform)
    alone = replace(scene, objects={name: replace(scene.objects[name], transform=shape)}, notes=())
    geometry = build_geometry(alone)
    return OwnMesh(name, tessellate(geometry) if cut else geometry, shape, placement)


def put_meshes(geometry: Geometry, meshes: list[OwnMesh]) -> Geometry:
    """`geometry` with these objects' meshes, which it holds uncut, in their own meshes' cutting.

    The vertices of the own meshes that are more come last, so that those of `geometry` stay where they were.
    """
    positions, normals, uvs = [geometry.positions], [geometry.normals], [geometry.uvs]
    owners, faces, face_owners = [geometry.vertex_object], [geometry.faces], [geometry.face_object]
    keep = np.ones(len(geometry.faces), bool)
    count = len(geometry.positions)
    for mesh in meshes:
        k = geometry.object_names.index(mesh.name)
        own = mesh.geometry
        number = vertex_numbers(geometry, k, len(own.positions), count)
        more = number >= count
        linear = mesh.placement[:3, :3]
        turned = own.normals[more].astype(np.float64) @ linear.T
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300)
        positions.append(own.positions[more] @ linear.T + mesh.placement[:3, 3])
        normals.append(turned.astype(np.float32))
        uvs.append(own.uvs[more])
        owners.append(np.full(int(more.sum()), k, np.int32))
        keep &= geometry.face_object != k
        faces.append(number[own.faces].astype(np.int32))
        face_owners.append(np.full(len(own.faces), k, np.int32))
        count += int(more.sum())
    faces[0], face_owners[0] = faces[0][keep], face_owners[0][keep]
    owner = np.concatenate(face_owners)
    order = np.argsort(owner, kind="stable")
    return replace(
        geometry,
        positions=np.concatenate(positions),
        normals=np.concatenate(normals),
        uvs=np.concatenate(uvs),
        faces=np.concatenate(faces)[order],
        vertex_object=np.concatenate(owners),
        face_object=owner[order],
    )


def vertex_numbers(geometry: Geometry, k: int, own: int, more_from: int) -> NDArray[np.int64]:
    """Vertices in the scene of an own mesh's `own` vertices: those of object k, then numbers from `more_from` on."""
    first = np.flatnonzero(geometry.vertex_object == k)
    return np.concatenate([first[:own], more_from + np.arange(max(0, own - len(first)))])

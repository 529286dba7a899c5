"""Files of skinned characters to arrays: the mesh in bind space, and its rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.gltf_skin import read_skinned
from relightcli.adapters.meshes import LoadedMesh, finish_mesh, read_file
from relightcli.core.pose.rig import Rig, any_tangents, joint_matrices
from relightcli.errors import InputError, RelightError

SUFFIXES = (".gltf", ".glb")


def load_rig(path: Path) -> tuple[LoadedMesh, Rig]:
    """Mesh in bind space and rig of a glTF file: all its meshes as one, vertex for vertex the rig's.

    Normals are the file's, else angle-weighted on the mesh as loaded. Weights are scaled to a sum of 1, with a note;
    faces that the skin's rest pose mirrors are turned around, so that fronts stay fronts.
    Raises InputError, naming the file, for whatever is no skinned mesh.
    """
    data, suffix = read_file(path)
    if suffix not in SUFFIXES:
        raise InputError(f'{path}: expected {" or ".join(SUFFIXES)} for motion = "skinned", found {suffix!r}.')
    try:
        found = read_skinned(path, data)
    except RelightError:
        raise
    except MemoryError:
        raise InputError(f"{path}: does not fit in memory.") from None
    except Exception as error:  # whatever a header of another shape than expected leads to
        raise InputError(f"{path}: cannot be read as a skinned {suffix[1:].upper()} ({error!r:.200}).") from error
    try:
        mesh = finish_mesh([skinned.part for skinned in found.parts], list(found.notes))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    width = max(skinned.joint.shape[1] for skinned in found.parts)
    joint = np.concatenate([_padded(s.joint, width) for s in found.parts]).astype(np.int32)
    weight = np.concatenate([_padded(s.weight, width) for s in found.parts]).astype(np.float64)
    rig = Rig(
        position=mesh.positions,
        normal=mesh.normals,
        tangent=any_tangents(mesh.normals),
        joint=joint,
        weight=weight,
        inverse_bind=np.array(found.inverse_bind),
        parent=np.array(found.parent, np.int32),
        rest=np.array(found.rest),
        translation=np.array(found.properties["translation"]),
        rotation=np.array(found.properties["rotation"]),
        scale=np.array(found.properties["scale"]),
        joint_node=np.array(found.joint_node, np.int32),
        node_names=tuple(found.node_names),
        clips=tuple(found.clips),
    )
    blended = np.einsum("vw,vwij->vij", rig.weight, joint_matrices(rig, None)[rig.joint][:, :, :3, :3])
    mirrored = (np.sign(np.linalg.det(blended))[mesh.faces] < 0).all(axis=1)
    faces = np.where(mirrored[:, None], mesh.faces[:, ::-1], mesh.faces)
    return replace(mesh, faces=np.ascontiguousarray(faces)), rig


def _padded(values: NDArray[np.int32] | NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Rows with zeros after them: no weight, on the first joint."""
    return np.pad(np.asarray(values, np.float64), ((0, 0), (0, width - values.shape[1])))

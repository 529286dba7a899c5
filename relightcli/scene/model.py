"""A scene as plain data: what the scene file says, resolved and validated, and the geometry as flat arrays.

Axis letters: V vertices, F faces. World space is right-handed, +Y up. Radiance is scene-linear RGB, Rec.709.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]
ModelName = Literal["lambert", "blinn-phong", "cook-torrance", "phong", "translucent"]
MotionName = Literal["static", "rigid", "skinned"]


@dataclass(frozen=True)
class Material:
    """One reflectance. Every parameter has a value; those the model does not use keep their defaults."""

    name: str
    model: ModelName = "lambert"
    diffuse: Vec3 = (0.5, 0.5, 0.5)  # albedo, 0..1
    specular: Vec3 = (0.0, 0.0, 0.0)  # 0..1
    transmittance: Vec3 = (0.0, 0.0, 0.0)  # translucent: albedo of the backward lobe, 0..1
    f0: float = 0.04  # cook-torrance: Schlick reflectance at normal incidence, 0..1
    roughness: float = 0.3  # cook-torrance: Beckmann m, > 0
    shininess: float = 50.0  # blinn-phong and phong exponent, >= 0
    diffuse_texture: Path | None = None  # absolute path; multiplies `diffuse`
    adjustable: bool = False


@dataclass(frozen=True)
class ObjectSpec:
    """One object as the scene file declares it."""

    name: str
    mesh: Path
    material: str
    transform: NDArray[np.float64]  # (4, 4), row-major, acts on column vectors
    two_sided: bool = False
    motion: MotionName = "static"
    motion_files: tuple[Path, ...] = ()  # skinned: BVH files, each a clip of its name
    joint_map: Path | None = None  # which of their joints moves which node


@dataclass(frozen=True)
class SphereLight:
    """Emits `radiance` outwards from every point of its surface. Blocks nothing, unseen by the camera."""

    name: str
    center: Vec3
    radius: float
    radiance: Vec3


@dataclass(frozen=True)
class RectangleLight:
    """A parallelogram around `center` with full edges `edge_u`, `edge_v`; emits towards edge_u x edge_v only."""

    name: str
    center: Vec3
    edge_u: Vec3
    edge_v: Vec3
    radiance: Vec3


@dataclass(frozen=True)
class Camera:
    """Pinhole. `fov` is the vertical angle in degrees; `size` is (width, height) in pixels, (0, 0) top left."""

    name: str
    eye: Vec3
    target: Vec3
    up: Vec3 = (0.0, 1.0, 0.0)
    fov: float = 40.0
    size: tuple[int, int] = (640, 480)


@dataclass(frozen=True)
class Scene:
    """A validated scene file. Dictionaries keep the file's order; paths are absolute and exist."""

    path: Path
    objects: dict[str, ObjectSpec]
    materials: dict[str, Material]
    lights: dict[str, SphereLight | RectangleLight] = field(default_factory=dict)
    environments: dict[str, Path] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    tolerance: float = 0.02
    notes: tuple[str, ...] = ()  # allowed but worth telling the user


@dataclass(frozen=True)
class Geometry:
    """All objects in world space as one indexed triangle mesh, in the order of `object_names`.

    positions     (V, 3) float64
    normals       (V, 3) float32, unit; the file's, else angle-weighted
    uvs           (V, 2) float32, NaN where the mesh has none
    faces         (F, 3) int32 into the vertices; counter-clockwise seen from the front
    vertex_object (V,) int32, face_object (F,) int32: index into object_names
    material      (O,) int32 per object: index into the scene's materials, in file order
    two_sided     (O,) bool per object
    textures      per material index: (H, W, 3) float32 linear RGB, for materials that have one
    notes         what was repaired or left out while loading, for the user to read
    rigs          of skinned objects, by name: `core.pose.rig.Rig`; its vertices are the object's, in order. The
                  arrays above hold the object as posed, in the rest pose unless something else is said
    """

    object_names: tuple[str, ...]
    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    uvs: NDArray[np.float32]
    faces: NDArray[np.int32]
    vertex_object: NDArray[np.int32]
    face_object: NDArray[np.int32]
    material: NDArray[np.int32]
    two_sided: NDArray[np.bool_]
    textures: dict[int, NDArray[np.float32]]
    notes: tuple[str, ...] = ()
    rigs: dict[str, Any] = field(default_factory=dict)

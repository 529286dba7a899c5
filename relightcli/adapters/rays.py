"""Embree behind three calls. Rays live in a normalised frame, so that the scale and place of a scene do not matter.

The frame recentres the scene on its bounding box and scales it by a power of two into [-1, 1]: the float32 mantissas
that Embree sees are then the same for a scene in millimetres and in kilometres. Parallelism is processes, each with a
`Tracer` of its own. Rays go to Embree in packets (`relightcli.adapters.embree`), or one by one where its library cannot
be called but through embreex.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.embree import PacketScene, library
from relightcli.core.parts import in_parts

# Distance of a ray's origin from its surface, in the normalised frame. Coordinates there are below 1, spaced by at
# most 2^-24; Embree's robust intersection is exact to a few such spacings.
SURFACE_OFFSET = 2.0**-19
MANY = 16_384  # rays that several threads share; fewer are done before another thread wakes


@dataclass(frozen=True)
class Hits:
    """Nearest hits. `face` (N,) int32, -1 where the ray leaves the scene; `u`, `v` (N,) float32 barycentric weights of
    the face's second and third corner; `distance` (N,) float32 in the normalised frame, in units of the direction."""

    face: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]


class Tracer:
    """A committed Embree scene over one indexed mesh.

    positions (V, 3) float64 world; faces (F, 3) int32. Zero-area faces are harmless. Non-finite vertices must have
    been refused before (Embree drops their faces in silence). threads: that share many rays, where rays let go of
    the interpreter's lock; the answers do not depend on them.
    """

    def __init__(self, positions: NDArray[np.float64], faces: NDArray[np.int32], threads: int = 1) -> None:
        used = np.zeros(len(positions), bool)
        used[faces] = True
        corners = positions[used] if len(faces) else np.zeros((1, 3))
        low, high = corners.min(axis=0), corners.max(axis=0)
        self.center: NDArray[np.float64] = 0.5 * (low + high)
        half = float(np.max(high - low)) * 0.5
        self.scale: float = 2.0 ** -math.ceil(math.log2(half)) if half > 0 else 1.0
        self.empty = len(faces) == 0
        self.threads = threads if library() else 1
        self._scene: PacketScene | SingleScene | None = None
        if not self.empty:
            vertices, triangles, loaded = self.to_local(positions), np.ascontiguousarray(faces, np.int32), library()
            self._scene = PacketScene(loaded, vertices, triangles) if loaded else SingleScene(vertices, triangles)

    def to_local(self, points: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """World points (..., 3) in the normalised frame, float32."""
        return np.ascontiguousarray((np.asarray(points, np.float64) - self.center) * self.scale, dtype=np.float32)

    def offset(self, points: NDArray[np.floating[Any]], normals: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Origins (N, 3) float32, normalised frame: world points moved off their surface along `normals`."""
        local = (np.asarray(points, np.float64) - self.center) * self.scale
        return np.ascontiguousarray(local + SURFACE_OFFSET * np.asarray(normals, np.float64), dtype=np.float32)

    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]:
        """True (N,) where anything lies along the ray, up to `max_distance` (N,) in units of the direction."""
        if self._scene is None or len(origins) == 0:
            return np.zeros(len(origins), bool)
        scene, far = self._scene, max_distance
        if len(origins) < MANY or self.threads == 1:
            return scene.occluded(origins, directions, far)
        blocked = np.empty(len(origins), bool)

        def part(a: int, b: int) -> None:
            blocked[a:b] = scene.occluded(origins[a:b], directions[a:b], None if far is None else far[a:b])

        in_parts(part, len(origins), self.threads)
        return blocked

    def intersect(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits:
        """Nearest hit of every ray. origins, directions (N, 3) float32 in the normalised frame."""
        n = len(origins)
        if self._scene is None or n == 0:
            zero = np.zeros(n, np.float32)
            return Hits(np.full(n, -1, np.int32), zero, zero, np.full(n, np.inf, np.float32))
        scene = self._scene
        if n < MANY or self.threads == 1:
            return Hits(*scene.intersect(origins, directions))
        face, hit = np.empty(n, np.int32), np.empty((3, n), np.float32)

        def part(a: int, b: int) -> None:
            own = slice(a, b)
            face[own], hit[0, own], hit[1, own], hit[2, own] = scene.intersect(origins[own], directions[own])

        in_parts(part, n, self.threads)
        return Hits(face, *hit)


class SingleScene:
    """A committed scene of triangles through embreex, which traces ray by ray; else as `PacketScene`."""

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene: Any = rtcore_scene.EmbreeScene(robust=True)
        self._keep: Any = TriangleMesh(self._scene, vertices, faces)

    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]:
        found: NDArray[np.int32] = self._scene.run(origins, directions, dists=max_distance, query="OCCLUDED")
        blocked: NDArray[np.bool_] = found == 0
        return blocked

    def intersect(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        found = self._scene.run(origins, directions, query="INTERSECT", output=True)
        return found["primID"], found["u"], found["v"], found["tfar"]

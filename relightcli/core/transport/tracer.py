"""What the mathematics needs of a ray tracer; `relightcli.adapters.rays` has it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Hits(Protocol):
    """Nearest hits: face (N,) int32, -1 for none; u, v (N,) float32, the barycentric weights of its second and third
    corner; distance (N,) float32 in the tracer's frame."""

    @property
    def face(self) -> NDArray[np.int32]: ...
    @property
    def u(self) -> NDArray[np.float32]: ...
    @property
    def v(self) -> NDArray[np.float32]: ...
    @property
    def distance(self) -> NDArray[np.float32]: ...


class Tracer(Protocol):
    """Rays against one mesh, in a frame of the tracer's own: x there is (x - center) * scale of the world."""

    center: NDArray[np.float64]
    scale: float

    def to_local(self, points: NDArray[np.floating[Any]]) -> NDArray[np.float32]: ...
    def offset(self, points: NDArray[np.floating[Any]], normals: NDArray[np.floating[Any]]) -> NDArray[np.float32]: ...
    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]: ...
    def intersect(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Hits: ...

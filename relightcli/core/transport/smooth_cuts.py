"""Faces cut where light that nothing blocks varies across them.

Light is known at vertices and interpolated between them. Where nothing casts a shadow it is even over a flat matte face
under the sky, and such a face is left whole. An edge is halved while it is longer than

    h(p) = min over the eyes e of s |p - e|  and over the local lights x of min(s, NEAR) |p - x|

or its ends' normals differ by more than t. p is its middle; s and t follow from the width w of the object's specular
lobe, in radians of the half vector (phong: of the mirrored view):

    w = m (Beckmann), sqrt(2/n) (exponent n);   s = w / 2,   t = 0.4 w, each within its range.

A Gaussian exp(-x^2/w^2) interpolated at steps of d is off by at most d^2/(4 w^2) of its peak: an edge of h turns the
half vector by w/4 or less, 2 %, and one of t by 0.4 w, 4 %. Objects without a lobe do not look at the eyes. NEAR: light
that falls with the square of the distance is off by 3 d^2/8 = 0.4 % at steps of d = NEAR distances. TURN: a cosine is
off by t^2/8 = 0.5 %.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from relightcli.core.transport.tessellation import F64, refine, unit_normals
from relightcli.scene.model import Geometry, Material

NEAR = 0.1
TURN = 0.2
SLOPES = (0.02, 0.1)
TURNS = (0.05, TURN)
LEAST = 512.0  # edges of an object's diagonal over this are not cut: an eye may lie on a face


def cut_for_shading(
    geometry: Geometry, materials: Sequence[Material], eyes: F64, lights: F64, whole: Collection[int] = ()
) -> Geometry:
    """The same scene with no edge longer than h, nor more bent than t; new vertices come after the old ones. The same
    object if none is.

    materials: as `geometry.material` counts them; eyes (n, 3), lights (m, 3): points, in metres; whole: indices
    of objects that are not cut. Where it would take too many vertices, both limits are widened until it does not.
    """
    limit = _ShadingLimit(geometry, [lobe_width(materials[m]) for m in geometry.material], eyes, lights, whole)
    return unit_normals(geometry, refine(geometry, limit))


def lobe_width(material: Material) -> float:
    """Width of the specular lobe, rad; infinite without one. An adjustable material that has none may be given one: as
    wide as the default roughness."""
    if material.model == "cook-torrance":
        width = material.roughness
    elif material.model in ("blinn-phong", "phong"):
        width = float(np.sqrt(2.0 / max(material.shininess, 1e-6)))
    else:
        return Material("").roughness if material.adjustable and material.model == "lambert" else np.inf
    return width if any(material.specular) or material.adjustable else np.inf


class _ShadingLimit:
    """h and t. See `tessellation.Limit`."""

    def __init__(
        self, geometry: Geometry, widths: Sequence[float], eyes: F64, lights: F64, whole: Collection[int]
    ) -> None:
        count = len(geometry.object_names)
        width = np.array(widths)
        self.eyes, self.lights = eyes, lights
        self.to_eyes = np.where(np.isfinite(width), np.clip(width / 2.0, *SLOPES), np.inf)
        self.to_lights = np.minimum(np.where(np.isfinite(width), self.to_eyes, np.inf), NEAR)
        self.turn = np.where(np.isfinite(width), np.clip(0.4 * width, *TURNS), TURN)
        self.floor = np.zeros(count)
        for k in range(count):
            corners = geometry.positions[geometry.faces[geometry.face_object == k].reshape(-1)]
            still = k in whole or geometry.object_names[k] in geometry.rigs or len(corners) == 0
            self.floor[k] = np.inf if still else float(np.linalg.norm(np.ptp(corners, axis=0))) / LEAST

    def exceeded(self, middle: F64, length: F64, owner: NDArray[np.int32], turn: F64) -> NDArray[np.bool_]:
        """Whether edges (M,) of these middles (M, 3), lengths, objects and angles between normals are beyond h or t."""
        out: NDArray[np.bool_] = turn > self.turn[owner]
        for points, slope in ((self.eyes, self.to_eyes[owner]), (self.lights, self.to_lights[owner])):
            for point in points:
                out |= length > slope * np.linalg.norm(middle - point, axis=1)
        return out & (length > self.floor[owner])

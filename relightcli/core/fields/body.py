"""An object alone, in its own frame: its mesh, the points of it that light is known at, and what they reflect.

Exit radiance of a point towards w is  sum over b of g_b(w) e_b,  e linear in the light that the point receives:

    b = 0        diffuse: g = 1, e = albedo / pi sum_i A_l(i) y_i(n) I_i                       [Pan 2007, Eq. 2]
    b = 1 .. N   specular, where the material has a lobe: e = specular times the coefficients of I in the point's frame,
                 g_lm = F_lm(theta) cos m phi, g_l-m = F_lm(theta) sin m phi of w in it (see `shade.low_order`)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import LAMBERT, MODEL_CODES, pack_materials
from relightcli.core.brdf.separable import POLAR
from relightcli.core.shade.lobe_factors import axes_of
from relightcli.core.shade.low_order import response
from relightcli.core.sphere import sh
from relightcli.core.transport.receivers import receivers_of_vertices, vertex_receivers
from relightcli.scene.model import Material


class Body(NamedTuple):
    """P points on V vertices, F faces; N = order^2.

    positions (V, 3) float64; normals (V, 3) float32; faces (F, 3) int32; two_sided: lit from both sides
    front, back (V,) int32: point on either side of a vertex, -1 where there is none
    point (P, 3) float64; normal (P, 3) float32 unit; vertex (P,) int32; side (P,) int8: 1 front, -1 back
    albedo (P, 3) float64, with the texture; specular (3,) float64
    lobe (POLAR, B) float32: F_lm, l slowest, m >= 0; no rows if the material has no specular lobe
    center (3,) float64, radius: bounding sphere
    order: bands of spherical harmonics
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    faces: NDArray[np.int32]
    two_sided: bool
    front: NDArray[np.int32]
    back: NDArray[np.int32]
    point: NDArray[np.float64]
    normal: NDArray[np.float32]
    vertex: NDArray[np.int32]
    side: NDArray[np.int8]
    albedo: NDArray[np.float64]
    specular: NDArray[np.float64]
    lobe: NDArray[np.float32]
    center: NDArray[np.float64]
    radius: float
    order: int

    @property
    def terms(self) -> int:
        """How many e_b there are: 1, or 1 + N."""
        return 1 + (self.order**2 if len(self.lobe) else 0)

    @property
    def colours(self) -> int:
        """1 if every colour is reflected alike, else 3."""
        grey = (self.albedo == self.albedo[:, :1]).all() and (not len(self.lobe) or np.ptp(self.specular) == 0.0)
        return 1 if grey else 3


def make_body(
    positions: NDArray[np.float64],
    normals: NDArray[np.float32],
    faces: NDArray[np.int32],
    two_sided: bool,
    texture: NDArray[np.float32],
    material: Material,
    order: int,
) -> Body:
    """The body of a mesh of one material, not translucent; texture (V, 3) multiplies the diffuse colour.

    The points lie along a Morton curve; a vertex that no face uses has none. Raises ValueError without faces.
    """
    if not len(faces):
        raise ValueError("a body needs at least one face")
    owner = np.zeros(len(positions), np.int32)
    points = vertex_receivers(positions, normals, faces, owner, np.array([two_sided]))
    front, back = receivers_of_vertices(points.vertex, points.side, len(positions))
    corners = positions[np.unique(faces)]
    center = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    code = MODEL_CODES[material.model]
    shines = code != LAMBERT and any(material.specular)
    row = pack_materials([material]).parameters[0]
    lobe = response(code, row, order) if shines else np.zeros((0, order * (order + 1) // 2), np.float32)
    albedo = np.array(material.diffuse) * texture[points.vertex].astype(np.float64)
    return Body(
        np.ascontiguousarray(positions, np.float64),
        np.ascontiguousarray(normals, np.float32),
        np.ascontiguousarray(faces, np.int32),
        two_sided,
        front,
        back,
        points.position,
        points.normal,
        points.vertex,
        points.side,
        albedo,
        np.array(material.specular, np.float64),
        lobe,
        center,
        float(np.sqrt(((corners - center) ** 2).sum(axis=1).max())),
        order,
    )


def clamped_cosine(order: int) -> NDArray[np.float64]:
    """A_l of every coefficient, (order^2,): irradiance(n) = sum A_l L_lm y_lm(n); pi, 2 pi/3, pi/4, 0, -pi/24, ...
    [Ramamoorthi 2001, Eq. 19]"""
    bands = np.zeros(order)
    for band in range(order):
        if band == 1:
            bands[band] = 2.0 * math.pi / 3.0
        elif band % 2 == 0:
            half = band // 2
            sign = -1.0 if half % 2 == 0 else 1.0
            bands[band] = sign * 2.0 * math.pi / ((band + 2) * (band - 1)) * math.comb(band, half) / 2.0**band
    return np.repeat(bands, 2 * np.arange(order) + 1)


def cosine_weights(normals: NDArray[np.floating], order: int) -> NDArray[np.float32]:
    """A_l y_i(n) of unit normals (P, 3), (P, N) float32: with the coefficients of light, the irradiance."""
    return (sh.harmonics(normals.astype(np.float64), order) * clamped_cosine(order)).astype(np.float32)


def diffuse_operator(body: Body) -> NDArray[np.float64]:
    """A_l y_i(n) / pi of every point, (P, N) float64: times the albedo, h of [Pan 2007, Eq. 2]."""
    unit = body.normal.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    out: NDArray[np.float64] = sh.harmonics(unit, body.order) * clamped_cosine(body.order) / math.pi
    return out


def local_rotations(normals: NDArray[np.float32], order: int) -> NDArray[np.float64]:
    """Matrices (P, N, N) float64 that take coefficients of the common frame to the points' own, z along the normal.

    R = Y(d)^+ Y(d'), with d fixed directions of the point's frame and d' the same in the common one: exact, because
    rotations keep the bands.
    """
    k = 4 * order * order
    index = np.arange(k) + 0.5
    z, phi = 1.0 - 2.0 * index / k, index * (math.pi * (3.0 - math.sqrt(5.0)))
    r = np.sqrt(1.0 - z * z)
    local = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    inverse = np.linalg.pinv(sh.harmonics(local, order))
    frames = axes(normals)
    out = np.empty((len(normals), order * order, order * order))
    for a in range(0, len(normals), 1024):
        world = np.einsum("kx,pxc->pkc", local, frames[a : a + 1024])
        out[a : a + 1024] = np.einsum("ik,pkj->pij", inverse, sh.harmonics(world, order))
    return out


def axes(normals: NDArray[np.float32]) -> NDArray[np.float64]:
    """The points' frames (P, 3, 3) float64, an axis a row, the last along the normal: those of `shade.low_order`."""
    out = np.empty((len(normals), 3, 3))
    _fill_axes(np.ascontiguousarray(normals, np.float64), out)
    return out


@njit(cache=True)
def _fill_axes(normals: Any, out: Any) -> None:
    for i in range(len(normals)):
        x, y, z = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        for k in range(3):
            out[i, 0, k], out[i, 1, k], out[i, 2, k] = x[k], y[k], z[k]


@njit(cache=True, error_model="numpy")
def fill_basis(lobe: Any, frame: Any, w: Any, order: int, out: Any) -> None:
    """g_b of direction w (3,) from a point of this frame (3, 3), into out (1 + N,); specular ones are 0 below it."""
    out[:] = 0.0
    out[0] = 1.0
    x = frame[0, 0] * w[0] + frame[0, 1] * w[1] + frame[0, 2] * w[2]
    y = frame[1, 0] * w[0] + frame[1, 1] * w[1] + frame[1, 2] * w[2]
    z = frame[2, 0] * w[0] + frame[2, 1] * w[1] + frame[2, 2] * w[2]
    if not z > 0.0:
        return
    length = math.sqrt(x * x + y * y)
    c1 = x / length if length > 0.0 else 0.0
    s1 = y / length if length > 0.0 else 0.0
    place = min(max(math.sqrt(max(0.0, 1.0 - z)) * POLAR - 0.5, 0.0), POLAR - 1.001)
    low = int(place)
    f = place - low
    k = 0
    for band in range(order):
        middle = 1 + band * (band + 1)
        c, s = 1.0, 0.0
        for m in range(band + 1):
            value = lobe[low, k] + f * (lobe[low + 1, k] - lobe[low, k])
            k += 1
            out[middle + m] = value * c
            if m > 0:
                out[middle - m] = value * s
            c, s = c * c1 - s * s1, s * c1 + c * s1

"""Sphere and rectangle lights: sampling, its density, and the points a ray meets.

One light is picked per sample with probability w_j / sum w, where w_j is luminance times (for rectangles roughly) the
solid angle of light j seen from the point; then

    sphere      a direction uniform in its cone, density 1 / (2 pi (1 - cos theta_max))   [Shirley 1996]
    rectangle   a point uniform over its area, density d^2 / (A cos theta)

A sphere emits outwards only: nothing arrives inside it, and a ray that crosses it meets its near side. A rectangle
(any parallelogram) emits towards edge_u x edge_v only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import Triple, dot
from relightcli.core.brdf.sampling import about, luminance
from relightcli.scene.model import RectangleLight, SphereLight

# A light lying flush in a surface is not hidden by it: rays towards local lights end this share before them.
LIGHT_CLEARANCE = 1e-4


class LocalLights(NamedTuple):
    """Lights as kernels read them, world space, float64.

    spheres     (N, 7): centre, radius, radiance RGB
    rectangles  (M, 15): corner, edge u, edge v, unit normal, radiance RGB
    """

    spheres: NDArray[np.float64]
    rectangles: NDArray[np.float64]

    @property
    def number(self) -> int:
        """How many there are."""
        return len(self.spheres) + len(self.rectangles)


def pack_lights(lights: Iterable[SphereLight | RectangleLight]) -> LocalLights:
    """Order is kept within each shape. Edges must not be parallel and radii positive (the scene reader checks)."""
    spheres: list[list[float]] = []
    rectangles: list[list[float]] = []
    for light in lights:
        if isinstance(light, SphereLight):
            spheres.append([*light.center, light.radius, *light.radiance])
        else:
            u, v = np.array(light.edge_u, np.float64), np.array(light.edge_v, np.float64)
            normal = np.cross(u, v)
            normal /= np.linalg.norm(normal)
            corner = np.array(light.center, np.float64) - 0.5 * (u + v)
            rectangles.append([*corner, *u, *v, *normal, *light.radiance])
    return LocalLights(np.array(spheres).reshape(-1, 7), np.array(rectangles).reshape(-1, 15))


@njit(cache=True, error_model="numpy")
def _vector(row: Any, k: int) -> Triple:
    return row[k], row[k + 1], row[k + 2]


@njit(cache=True, error_model="numpy")
def _minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, error_model="numpy")
def _cone_height(sphere: Any, p: Triple) -> float:
    """1 - cos theta_max of the sphere seen from p, without cancellation; 0 inside it."""
    c = _minus(_vector(sphere, 0), p)
    distance2 = dot(c, c)
    radius2 = sphere[3] * sphere[3]
    if not distance2 > radius2:
        return 0.0
    sine2 = radius2 / distance2
    return sine2 / (1.0 + math.sqrt(1.0 - sine2))


@njit(cache=True, error_model="numpy")
def _weight(lights: LocalLights, j: int, p: Triple) -> float:
    """w_j: luminance times solid angle; above 0 wherever the light sends anything to p."""
    if j < len(lights.spheres):
        sphere = lights.spheres[j]
        return luminance(_vector(sphere, 4)) * 2.0 * math.pi * _cone_height(sphere, p)
    r = lights.rectangles[j - len(lights.spheres)]
    to_corner = _minus(p, _vector(r, 0))
    height = dot(to_corner, _vector(r, 9))
    if not height > 0.0:
        return 0.0
    u, v = _vector(r, 3), _vector(r, 6)
    x = _minus(to_corner, (0.5 * (u[0] + v[0]), 0.5 * (u[1] + v[1]), 0.5 * (u[2] + v[2])))
    distance2 = dot(x, x)
    area = parallelogram_area(r)
    # The far-field solid angle A h / d^3, kept below 2 pi near the light.
    solid_angle = area * height / ((distance2 + area / (2.0 * math.pi)) * math.sqrt(distance2))
    return luminance(_vector(r, 12)) * solid_angle


@njit(cache=True, error_model="numpy")
def parallelogram_area(r: Any) -> float:
    """|u x v| of a row of `rectangles`."""
    x = r[4] * r[8] - r[5] * r[7]
    y = r[5] * r[6] - r[3] * r[8]
    z = r[3] * r[7] - r[4] * r[6]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, error_model="numpy")
def total_weight(lights: LocalLights, p: Triple) -> float:
    """Sum of w_j at p; 0 where no light sends anything."""
    total = 0.0
    for j in range(len(lights.spheres) + len(lights.rectangles)):
        total += _weight(lights, j, p)
    return total


@njit(cache=True, error_model="numpy")
def sample_light(lights: LocalLights, p: Triple, u1: float, u2: float) -> tuple[Triple, float, Triple, float]:
    """Draw a point of a light as seen from p: (unit direction, distance, radiance, density in sr^-1); density 0: none.

    u1, u2 in [0, 1).
    """
    nothing = ((0.0, 1.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0)
    total = total_weight(lights, p)
    if not total > 0.0:
        return nothing
    target = u1 * total
    chosen, below, weight = -1, 0.0, 0.0
    running = 0.0
    for j in range(len(lights.spheres) + len(lights.rectangles)):
        w = _weight(lights, j, p)
        if w > 0.0:
            chosen, below, weight = j, running, w
            running += w
            if target < running:
                break
    u = min(max((target - below) / weight, 0.0), 1.0)
    share = weight / total
    if chosen < len(lights.spheres):
        sphere = lights.spheres[chosen]
        height = _cone_height(sphere, p)
        c = _minus(_vector(sphere, 0), p)
        distance = math.sqrt(dot(c, c))
        z = u * height  # 1 - cos theta
        sine2 = z * (2.0 - z)
        sine, phi = math.sqrt(sine2), 2.0 * math.pi * u2
        d = about(
            (c[0] / distance, c[1] / distance, c[2] / distance), sine * math.cos(phi), sine * math.sin(phi), 1.0 - z
        )
        near = distance * (1.0 - z) - math.sqrt(max(0.0, sphere[3] * sphere[3] - distance * distance * sine2))
        return d, near, _vector(sphere, 4), share / (2.0 * math.pi * height)
    r = lights.rectangles[chosen - len(lights.spheres)]
    d = _minus((r[0] + u * r[3] + u2 * r[6], r[1] + u * r[4] + u2 * r[7], r[2] + u * r[5] + u2 * r[8]), p)
    distance = math.sqrt(dot(d, d))
    cosine = -dot(d, _vector(r, 9)) / distance
    if not cosine > 0.0:
        return nothing
    density = share * distance * distance / (parallelogram_area(r) * cosine)
    return (d[0] / distance, d[1] / distance, d[2] / distance), distance, _vector(r, 12), density


@njit(cache=True, error_model="numpy")
def meet_light(lights: LocalLights, j: int, p: Triple, d: Triple, total: float) -> tuple[float, Triple, float]:
    """Where the ray p + t d, d unit, meets light j: (t, radiance, density of `sample_light`); t = inf: it does not.

    total: `total_weight` at p, above 0.
    """
    miss = (math.inf, (0.0, 0.0, 0.0), 0.0)
    if j < len(lights.spheres):
        sphere = lights.spheres[j]
        height = _cone_height(sphere, p)
        if height == 0.0:
            return miss
        c = _minus(_vector(sphere, 0), p)
        along = dot(c, d)
        off = _minus(c, (along * d[0], along * d[1], along * d[2]))
        inside = sphere[3] * sphere[3] - dot(off, off)
        if along <= 0.0 or inside < 0.0:
            return miss
        radiance = _vector(sphere, 4)
        share = luminance(radiance) * 2.0 * math.pi * height / total
        return along - math.sqrt(inside), radiance, share / (2.0 * math.pi * height)
    r = lights.rectangles[j - len(lights.spheres)]
    n = _vector(r, 9)
    cosine = -dot(d, n)
    to_p = _minus(p, _vector(r, 0))
    height = dot(to_p, n)
    if not (cosine > 0.0 and height > 0.0):
        return miss
    t = height / cosine
    x = (to_p[0] + t * d[0], to_p[1] + t * d[1], to_p[2] + t * d[2])
    u, v = _vector(r, 3), _vector(r, 6)
    uu, uv, vv = dot(u, u), dot(u, v), dot(v, v)
    determinant = uu * vv - uv * uv
    a = (dot(x, u) * vv - dot(x, v) * uv) / determinant
    b = (dot(x, v) * uu - dot(x, u) * uv) / determinant
    if not (0.0 <= a <= 1.0 and 0.0 <= b <= 1.0):
        return miss
    density = _weight(lights, j, p) / total * t * t / (math.sqrt(determinant) * cosine)
    return t, _vector(r, 12), density

"""Source fields: a local light as it is seen from samples around it. [Pan 2007, section 3; Zhou 2005]

A sphere of radius r and even radiance L is a disc of sine r / distance about the direction d to its centre:

    L_lm = L 2 pi (1 - c^2) P_l'(c) / (l (l + 1)) y_lm(d),   L_00 = L 2 pi (1 - c) y_00,   c = cos(half-angle)

the integral of P_l from c to 1, usually written (P_(l-1)(c) - P_(l+1)(c)) / (2 l + 1), a difference that has no digit
left for a small disc, where both are nearly 1.

A rectangle's is the integral over its area of y(direction) cos / distance^2 where it faces the sample, by
Gauss-Legendre points: NEAR_NODES along an edge within two of its radii, FAR_NODES beyond.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.field import SourceField, shell_radii
from relightcli.core.fields.sampling import sample_points
from relightcli.core.sphere import sh
from relightcli.scene.model import RectangleLight, SphereLight

NEAR_NODES, FAR_NODES = 64, 16
_SLAB = 1 << 20  # pairs of sample and node at a time


def source_field(
    light: SphereLight | RectangleLight, shells: int, resolution: int, order: int, spacing: str = "geometric"
) -> SourceField:
    """The field of a light about its own centre, with the axes of the scene: moving it moves the field."""
    if isinstance(light, SphereLight):
        radius = light.radius
    else:
        u, v = np.array(light.edge_u), np.array(light.edge_v)
        radius = 0.5 * max(float(np.linalg.norm(u + v)), float(np.linalg.norm(u - v)))
    center = np.zeros(3)
    radii = shell_radii(radius, shells, spacing)
    cells = 6 * resolution * resolution
    seen = np.empty((shells, cells, order * order))
    for s in range(shells):
        points = sample_points(center, radii, resolution, s * cells, (s + 1) * cells)
        if isinstance(light, SphereLight):
            seen[s] = disc_light(-points, radius, order)
        else:
            seen[s] = rectangle_light(points, u, v, order, NEAR_NODES if radii[s] < 2.0 * radius else FAR_NODES)
    radiance = (seen[..., None] * np.array(light.radiance)).astype(np.float32)
    return SourceField(center, radius, radii, resolution, radiance)


def disc_light(to_center: NDArray[np.float64], radius: float, order: int) -> NDArray[np.float64]:
    """Coefficients (n, N) of unit radiance from spheres at to_center (n, 3); 0 from inside, where nothing arrives."""
    distance = np.linalg.norm(to_center, axis=1)
    outside = distance > radius
    far = np.where(outside, distance, radius)
    sine2 = (radius / far) ** 2
    c = np.sqrt((far - radius) * (far + radius)) / far
    legendre, slope = [np.ones(len(c)), c], [np.zeros(len(c)), np.ones(len(c))]
    for band in range(1, order - 1):
        legendre.append(((2 * band + 1) * c * legendre[band] - band * legendre[band - 1]) / (band + 1))
        slope.append(slope[band - 1] + (2 * band + 1) * legendre[band])
    factors = [2.0 * math.pi * sine2 / (1.0 + c)]
    factors += [2.0 * math.pi * sine2 * slope[b] / (b * (b + 1)) for b in range(1, order)]
    per_term = np.stack(factors, axis=1)[:, np.repeat(np.arange(order), 2 * np.arange(order) + 1)]
    direction = to_center / np.where(outside, distance, 1.0)[:, None]
    out = np.zeros((len(c), order * order))
    out[outside] = (per_term * sh.harmonics(direction, order))[outside]
    return out


def rectangle_light(
    points: NDArray[np.float64], u: NDArray[np.float64], v: NDArray[np.float64], order: int, nodes: int
) -> NDArray[np.float64]:
    """Coefficients (n, N), as points (n, 3) see unit radiance from a parallelogram about the origin with edges u, v."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    places = (0.5 * x[:, None, None] * u + 0.5 * x[None, :, None] * v).reshape(-1, 3)
    cross = np.cross(u, v)
    weights = (0.25 * weight[:, None] * weight[None, :]).reshape(-1)
    out = np.zeros((len(points), order * order))
    facing = np.flatnonzero(points @ cross > 0.0)
    for rows in np.array_split(facing, max(1, math.ceil(len(facing) * len(places) / _SLAB))):
        way = places[None] - points[rows, None]
        distance2 = (way**2).sum(axis=2)
        way /= np.sqrt(distance2)[..., None]
        flux = np.maximum(-(way * cross).sum(axis=2), 0.0) / distance2 * weights
        out[rows] = (sh.harmonics(way, order) * flux[..., None]).sum(axis=1)
    return out

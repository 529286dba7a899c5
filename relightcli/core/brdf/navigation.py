"""Which mix of a BRDF set's entries stands for a parameter point between them. [Sun 2007, sec. 4.2]

The weights w_h >= 0 sum to 1. Both the tensor's rows w'U_h and the basis coefficients follow from them, linearly, and
so agree with each other. An entry's own point gives exactly one weight, of 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

# Points of the plane closer to a line or a hull than this part of the set's extent lie on it.
_ON = 1e-9


@dataclass(frozen=True, eq=False)
class Mix:
    """weights (H,) float64; outside: the point is beyond what the set spans, and the nearest mix was taken."""

    weights: NDArray[np.float64]
    outside: bool


def exponent_mix(exponents: NDArray[np.float64], exponent: float) -> Mix:
    """Linear between the two neighbours of `exponent` among `exponents` (H,), in any order, not empty."""
    points = np.asarray(exponents, np.float64)
    same = np.flatnonzero(points == exponent)
    if len(same):
        return _one(len(points), int(same[0]), False)
    order = np.argsort(points, kind="stable")
    above = int(np.searchsorted(points[order], exponent))
    if above in (0, len(points)):
        return _one(len(points), int(order[min(above, len(points) - 1)]), True)
    low, high = order[above - 1], order[above]
    return _between(len(points), int(low), int(high), (exponent - points[low]) / (points[high] - points[low]), False)


def fresnel_roughness_mix(points: NDArray[np.float64], f0: float, roughness: float) -> Mix:
    """Barycentric in the Delaunay triangulation of `points` (H, 2) of f0 and roughness (above 0), not empty.

    Triangulated and interpolated over (f0, log roughness), each scaled to the points' extent: lobes resemble each
    other by the ratio of their widths, and roughnesses of real materials run over two decades. Outside of the hull the
    nearest point of it is taken, in that scale; a set on one line is interpolated along the line.
    """
    found = np.asarray(points, np.float64)
    same = np.flatnonzero((found[:, 0] == f0) & (found[:, 1] == roughness))
    if len(same):
        return _one(len(found), int(same[0]), False)
    plane = np.stack([found[:, 0], np.log(found[:, 1])], 1)
    extent = np.ptp(plane, axis=0)
    extent[extent == 0.0] = 1.0
    query = (np.array([f0, math.log(roughness)]) - plane[0]) / extent
    plane = (plane - plane[0]) / extent
    try:
        mesh = Delaunay(plane)
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return _along_line(plane, query)
    triangle = int(mesh.find_simplex(query))
    if triangle < 0:
        return _on_hull(plane, mesh.convex_hull, query)
    affine = mesh.transform[triangle]
    first = affine[:2] @ (query - affine[2])
    weights = np.zeros(len(found))
    corner = np.maximum(np.append(first, 1.0 - first.sum()), 0.0)
    weights[mesh.simplices[triangle]] = corner / corner.sum()
    return Mix(weights, False)


def _along_line(plane: NDArray[np.float64], query: NDArray[np.float64]) -> Mix:
    """The set on one line through its first point: (H, 2); `query` (2,) is projected onto it."""
    far = plane[(plane**2).sum(1).argmax()]
    length = math.hypot(*far)
    if length == 0.0:
        return _one(len(plane), 0, True)
    axis = far / length
    mix = exponent_mix(plane @ axis, float(query @ axis))
    off = abs(float(axis[0] * query[1] - axis[1] * query[0])) > _ON
    return Mix(mix.weights, mix.outside or off)


def _on_hull(plane: NDArray[np.float64], edges: NDArray[np.intp], query: NDArray[np.float64]) -> Mix:
    """The point of the hull's `edges` (e, 2) nearest to `query`."""
    a, b = plane[edges[:, 0]], plane[edges[:, 1]]
    along = b - a
    part = np.clip(((query - a) * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
    distance = np.hypot(*(a + part[:, None] * along - query).T)
    edge = int(distance.argmin())
    outside = bool(distance[edge] > _ON)
    return _between(len(plane), int(edges[edge, 0]), int(edges[edge, 1]), float(part[edge]), outside)


def _one(count: int, index: int, outside: bool) -> Mix:
    weights = np.zeros(count)
    weights[index] = 1.0
    return Mix(weights, outside)


def _between(count: int, low: int, high: int, part: float, outside: bool) -> Mix:
    weights = np.zeros(count)
    weights[low] = 1.0 - part
    weights[high] += part
    return Mix(weights, outside)

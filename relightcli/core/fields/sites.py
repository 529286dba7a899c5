"""Sites: the few of an object's points that look around at what stands, and how all others take light from them.

Points are told apart by where they are and by where they look, p and TURNED times the object's radius times n: light
from below differs between the side of a foot and its sole, next to each other. Sites are spread over that, each one as
far as can be from those before it, so that small parts next to a floor have theirs as well as large ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

NEAREST = 4  # sites that a point takes light from
TURNED = 0.3  # radii of the object that a normal counts for which is turned by a radian


def outlook(points: NDArray[np.float64], normals: NDArray[np.float32], radius: float) -> NDArray[np.float64]:
    """What points (n, 3) with these normals (n, 3) are told apart by, (n, 6) float64."""
    return np.concatenate([points, TURNED * radius * normals.astype(np.float64)], axis=1)


def spread_out(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Rising indices of at most `count` different ones of the points (n, D), n > 0: the farthest from their mean, then
    again and again the farthest from those before."""
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())]
    least = np.full(len(points), np.inf)
    while len(chosen) < count:
        least = np.minimum(least, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        farthest = int(least.argmax())
        if not least[farthest] > 0.0:
            break
        chosen.append(farthest)
    return np.sort(np.array(chosen, np.int64))


class Between(NamedTuple):
    """How points take what sites have: site (n, NEAREST) int64, weight (n, NEAREST) float32, rows summing to 1."""

    site: NDArray[np.int64]
    weight: NDArray[np.float32]

    def blend(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Values (S, ...) float32 at the points, (n, ...)."""
        flat = np.ascontiguousarray(values.reshape(len(values), -1))
        out = np.zeros((len(self.site), flat.shape[1]), np.float32)
        _blend(self.site, self.weight, flat, out)
        return out.reshape(-1, *values.shape[1:])


@njit(cache=True, nogil=True)
def _blend(site, weight, values, out):  # type: ignore[no-untyped-def]
    for i in range(len(site)):
        for k in range(site.shape[1]):
            w, own = weight[i, k], values[site[i, k]]
            for j in range(len(own)):
                out[i, j] += w * own[j]


def between(points: NDArray[np.float64], sites: NDArray[np.float64]) -> Between:
    """Weights of sites (S, D) at points (n, D), S > 0: by the inverse square of the distance, of the NEAREST ones."""
    distance, site = cKDTree(sites).query(points, k=min(NEAREST, len(sites)))
    distance, site = distance.reshape(len(points), -1), site.reshape(len(points), -1)
    # Relative to the nearest; 0 / 0 at a site itself, which has all of the weight.
    first = distance[:, :1]
    ratio = np.divide(first, distance, out=np.ones_like(distance), where=distance > 0.0) ** 2
    weight = np.where(first > 0.0, ratio, (distance == 0.0).astype(np.float64))
    return Between(site, (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32))

"""Light that standing receivers lose to what moves in front of them.

Of the sky: the irradiance past the moving things, V_M = sum_i V_i y_i of N terms, is

    E = sum_i V_i W_i,   W_i = integral over the visible sky of L (n . w) y_i(w)

exact but for what V_M has been cut to; W hangs on the sky alone. Of what stands: a cell of a gather keeps the part
V_e(w) of its light for each moving thing e that lies before the receiver seen there.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.fields.chain import EVEN
from relightcli.core.fields.entities import Lookup
from relightcli.core.lights.environment import SkyCube
from relightcli.core.parts import in_parts
from relightcli.core.shade.gather import Gather
from relightcli.core.sphere import cube, sh


def sky_basis(sky: SkyCube, order: int) -> NDArray[np.float64]:
    """Moments times y_i at the centre of every texel, (T, 9 N) float64: colour, then axis, then i."""
    y = sh.harmonics(cube.texel_directions(sky.resolution).reshape(-1, 3), order)
    moments = sky.moment.reshape(len(y), 9)
    out: NDArray[np.float64] = (moments[:, :, None] * y[:, None, :]).reshape(len(y), -1)
    return out


def sky_terms(bits: NDArray[np.uint8], normals: NDArray[np.float32], basis: NDArray[np.float64]) -> NDArray[np.float32]:
    """W (n, 3, N) float32; bits (n, 6, R, R/8), normals (n, 3), basis from `sky_basis`."""
    sums = sh.run_sums(bits, basis).reshape(len(bits), 3, 3, -1)
    out = np.zeros((len(bits), 3, sums.shape[3]))
    for axis in range(3):
        out += normals[:, axis, None, None] * sums[:, :, axis]
    return out.astype(np.float32)


def may_block(
    points: NDArray[np.float64],
    light: NDArray[np.float64],
    light_radius: float,
    center: NDArray[np.float64],
    radius: float,
) -> NDArray[np.bool_]:
    """Where (n,) a ball may come between points (n, 3) and a light within another ball: where it meets the capsule
    about the way to the light's centre."""
    way = light - points
    along = ((center - points) * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-300)
    nearest = points + np.clip(along, 0.0, 1.0)[:, None] * way
    out: NDArray[np.bool_] = ((nearest - center) ** 2).sum(axis=1) <= (radius + light_radius) ** 2
    return out


def passing_mirrored(
    passed: NDArray[np.float32], normals: NDArray[np.floating], view: NDArray[np.floating]
) -> NDArray[np.float32]:
    """V_M (n, N) in the direction that mirrors the view (n, 3) at normals (n, 3), cut to 0 .. 1: (n,) float32."""
    n, v = normals.astype(np.float64), view.astype(np.float64)
    mirrored = 2.0 * (n * v).sum(axis=1, keepdims=True) * n - v
    mirrored /= np.maximum(np.linalg.norm(mirrored, axis=1, keepdims=True), 1e-300)
    values = (sh.harmonics(mirrored, math.isqrt(passed.shape[1])) * passed).sum(axis=1)
    return np.clip(values, 0.0, 1.0).astype(np.float32)


def hidden_by(lookup: Lookup, passes: NDArray[np.float32], movers: int) -> NDArray[np.float32]:
    """Coefficients (n, E, N) of what each of the first `movers` entities hides of even light, nothing of the others:
    1 - V_e, from what passes the samples (T, N) that the points read."""
    n, count = lookup.place.shape[:2]
    hidden = np.zeros((n, count, passes.shape[1]), np.float32)
    for e in range(movers):
        weight = lookup.weight[:, e]
        hidden[:, e, 0] = EVEN * weight.sum(axis=1)
        for k in range(weight.shape[1]):
            hidden[:, e] -= weight[:, k, None] * passes[lookup.place[:, e, k]]
    return hidden


def dim(
    gather: Gather,
    positions: NDArray[np.float64],
    hidden: NDArray[np.float32],
    centers: NDArray[np.float64],
    radii: NDArray[np.float64],
    threads: int = 1,
) -> tuple[Gather, NDArray[np.float32]]:
    """The gather past E moving things; and the share (n, E) float32 of each that nothing standing hides.

    positions (N, 3) of all receivers, the gather's n first; hidden (n, E, N) coefficients of what each thing hides of
    even light, in the world's frame; centers (E, 3), radii (E,): bounding spheres. Before a thing lies what is nearer
    than the middle of its bounding sphere along the cell's direction.
    """
    n, count = hidden.shape[:2]
    cosine, solid = gather.cosine.copy(), gather.solid_angle.copy()
    share = np.ones((n, count), np.float32)
    directions = cube.texel_directions(gather.cells).reshape(-1, 3)
    whole = np.tile(cube.solid_angles(gather.cells).reshape(-1), 6)
    y = sh.harmonics(directions, math.isqrt(hidden.shape[2]))
    p = np.ascontiguousarray(positions, np.float64)

    def part(a: int, b: int) -> None:
        _dim(
            a, b, gather.start, gather.source, gather.cell, gather.solid_angle, p, directions, whole, y, hidden,
            centers, radii, cosine, solid, share,
        )  # fmt: skip

    in_parts(part, n, threads)
    return gather._replace(cosine=cosine, solid_angle=solid), share


@njit(cache=True, nogil=True)
def _dim(  # type: ignore[no-untyped-def]
    first, last, start, source, cell, solid_angle, positions, directions, whole, y, hidden, centers, radii, cosine,
    solid, share,
):  # fmt: skip
    side = round(math.sqrt(len(directions) / 6))
    narrow = 1.0 / math.sqrt(1.0 + 2.0 / (side * side))  # a cone of so large a cosine may have no cell's centre in it
    for i in range(first, last):
        if start[i] == start[i + 1]:
            continue
        p = positions[i]
        for e in range(len(centers)):
            x, up, out = centers[e, 0] - p[0], centers[e, 1] - p[1], centers[e, 2] - p[2]
            far2 = x * x + up * up + out * out
            outside = far2 > radii[e] * radii[e]
            least = math.inf  # of the distance of the ball's middle along a direction in its cone
            if outside:
                least = math.sqrt(far2) * min(math.sqrt(1.0 - radii[e] * radii[e] / far2), narrow)
            covered = 0.0
            for z in range(start[i], start[i + 1]):
                k = cell[z]
                d, q = directions[k], positions[source[z]]
                middle = d[0] * x + d[1] * up + d[2] * out
                distance = math.sqrt((q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2)
                if distance < middle:
                    if middle >= least:
                        covered += solid_angle[z]
                    continue
                lost = 0.0
                for j in range(y.shape[1]):
                    lost += hidden[i, e, j] * y[k, j]
                left = np.float32(max(1.0 - lost, 0.0))
                cosine[z] *= left
                solid[z] *= left
            if covered > 0.0:
                total = 0.0
                for k in range(len(directions)):
                    d = directions[k]
                    if d[0] * x + d[1] * up + d[2] * out >= least:
                        total += whole[k]
                share[i, e] = max(0.0, 1.0 - covered / total)

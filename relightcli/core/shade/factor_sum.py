"""Light of the factors of BRDFs at receivers, from clusters of the sky's light. [Sun 2007, sec. 4.1]

    I0(i, k) = integral of V_i U_k (n_i . w)+ L dw  ~  sum over groups g of U_k(w_ig) E_ig
    E_ig = sum over the clusters c of g of f_ic F_c g(n_i . w_c, r_c),    w_ig = their mean direction, weighted by E

in the frame of the receiver (`lobe_factors.axes_of`), f the visible fractions, F_c the flux, w_c the mean direction and
r_c half the side of a cluster, g(x, r) its cosine about the horizon (`transport.light_clusters`). A factor U is smooth
and known: where it is linear over a group the sum is as good as one over the clusters, and U is taken once for all of
them. So light of any map becomes light of the factors without transfer being stored for them.

U is bilinear between the cells of the disc; so E is first shared out over the cells at a receiver, and then multiplied
by the factors, however many they are. A cluster that is larger than a group is in parts, which have its fractions.
Directions are those of all colours together. Nothing is added to what was there before: sums are float64 within a
group, float32 over the groups.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.latlong import LUMINANCE
from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.lights.points import Points
from relightcli.core.parts import in_parts
from relightcli.core.shade.cluster_sum import ALL, GROUP, NONE, Fractions
from relightcli.core.shade.lobe_factors import axes_of
from relightcli.core.shade.seen_points import Seen
from relightcli.core.transport.direct_tensor import place_on_disc

# Order of sums is free, so that loops become vector instructions.
_FAST = {"reassoc", "contract", "nsz"}


def factor_light(
    fractions: Fractions,
    receiver: NDArray[np.integer],
    light: LeafLight,
    cell: NDArray[np.int64],
    radius: NDArray[np.float64],
    start: NDArray[np.int64],
    seen: Seen,
    points: Points,
    table: NDArray[np.float32],
    threads: int = 1,
) -> NDArray[np.float32]:
    """I0 (n, K, 3) float32, radiance times sr sr^-1, at n receivers, rising indices.

    light: of e parts of clusters, flux (e, 3) and moment (e, 3, 3); cell (e,): the cluster of each in `fractions`;
    radius (e,): half their sides; start (p + 1,): the parts of every group; points: light beside that, or to be taken
    away from it, seen (P, N) bool, or the visible part as float32; table (D, D, K): factors over the disc, as of
    `direct_model.LightFactors`.
    """
    side, count = table.shape[1:]
    factors = np.ascontiguousarray(table.reshape(side * side, count).T)
    groups = len(fractions.place)
    row = np.full((groups, GROUP), -1, np.int32)
    row.reshape(-1)[receiver] = np.arange(len(receiver))
    used = np.flatnonzero((row >= 0).any(axis=1))
    total = light.flux.sum(axis=1)[:, None]
    mean = np.divide(light.moment.sum(axis=1), total, out=np.zeros((len(total), 3)), where=total != 0.0)
    weight = light.flux @ LUMINANCE
    out = np.zeros((len(receiver), count, 3), np.float32)

    def part(a: int, b: int) -> None:
        _sum(
            used[a:b], fractions.place, fractions.mixed, fractions.normal, row, start, cell, light.flux, weight, mean,
            radius, seen, points.direction, points.flux, side, factors, out,
        )  # fmt: skip

    in_parts(part, len(used), threads)
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _share_out(disc, side, x, y, red, green, blue):  # type: ignore[no-untyped-def]
    """Adds a colour at a place of the disc to the four cells about it, of (3, side x side)."""
    i, j, a, b = place_on_disc(np.float32(x), np.float32(y), side)
    r, g, e = np.float32(red), np.float32(green), np.float32(blue)
    w3 = a * b
    w1, w2 = b - w3, a - w3
    w0 = np.float32(1.0) - a - w1
    at = i * side + j
    below = at + side
    disc[0, at] += w0 * r
    disc[1, at] += w0 * g
    disc[2, at] += w0 * e
    disc[0, at + 1] += w1 * r
    disc[1, at + 1] += w1 * g
    disc[2, at + 1] += w1 * e
    disc[0, below] += w2 * r
    disc[1, below] += w2 * g
    disc[2, below] += w2 * e
    disc[0, below + 1] += w3 * r
    disc[1, below + 1] += w3 * g
    disc[2, below + 1] += w3 * e


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _multiply(factors, disc, out):  # type: ignore[no-untyped-def]
    """out (K, 3) of factors (K, C) and light (3, C)."""
    red, green, blue = disc[0], disc[1], disc[2]
    for k in range(len(factors)):
        u = factors[k]
        r = g = b = np.float32(0.0)
        for cell in range(len(u)):
            r += u[cell] * red[cell]
            g += u[cell] * green[cell]
            b += u[cell] * blue[cell]
        out[k, 0], out[k, 1], out[k, 2] = r, g, b


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _sum(  # type: ignore[no-untyped-def]
    used,
    place,
    mixed,
    normal,
    row,
    start,
    cell,
    flux,
    weight,
    mean,
    radius,
    seen,
    direction,
    point_flux,
    side,
    factors,
    out,
):
    sums = np.empty((6, GROUP))  # light by colour, and directions times luminance
    tangent = np.empty((2, 3, GROUP))
    disc = np.empty((GROUP, 3, side * side), np.float32)
    whole = np.empty((4, 3))  # moment by colour and of luminance, of what all 64 see
    for g in used:
        x, y, z = normal[g, 0], normal[g, 1], normal[g, 2]
        for i in range(GROUP):
            s, t, _ = axes_of((x[i], y[i], z[i]))
            tangent[0, 0, i], tangent[0, 1, i], tangent[0, 2, i] = s
            tangent[1, 0, i], tangent[1, 1, i], tangent[1, 2, i] = t
        disc[:] = np.float32(0.0)
        red, green, blue, dx, dy, dz = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
        for p in range(len(start) - 1):
            some, every = False, False
            for e in range(start[p], start[p + 1]):
                q = place[g, cell[e]]
                if q == NONE or weight[e] == 0.0:
                    continue
                if not some:
                    some = True
                    sums[:] = 0.0
                    whole[:] = 0.0
                a, b, d = mean[e, 0], mean[e, 1], mean[e, 2]
                if q == ALL:
                    every = True
                    for c in range(3):
                        for k in range(3):
                            whole[c, k] += flux[e, c] * mean[e, k]
                    for k in range(3):
                        whole[3, k] += weight[e] * mean[e, k]
                    continue
                part = mixed[q]
                r, steep, w = radius[e], 0.25 / radius[e], weight[e] / 255.0
                fr, fg, fb = flux[e, 0] / 255.0, flux[e, 1] / 255.0, flux[e, 2] / 255.0
                for i in range(GROUP):
                    h = x[i] * a + y[i] * b + z[i] * d
                    low = max(h + r, 0.0)
                    v = np.float64(part[i]) * (h if h >= r else low * low * steep)
                    red[i] += fr * v
                    green[i] += fg * v
                    blue[i] += fb * v
                    v *= w
                    dx[i] += v * a
                    dy[i] += v * b
                    dz[i] += v * d
            if not some:
                continue
            if every:
                length = math.sqrt(whole[3, 0] ** 2 + whole[3, 1] ** 2 + whole[3, 2] ** 2)
                for i in range(GROUP):
                    red[i] += x[i] * whole[0, 0] + y[i] * whole[0, 1] + z[i] * whole[0, 2]
                    green[i] += x[i] * whole[1, 0] + y[i] * whole[1, 1] + z[i] * whole[1, 2]
                    blue[i] += x[i] * whole[2, 0] + y[i] * whole[2, 1] + z[i] * whole[2, 2]
                    v = (x[i] * whole[3, 0] + y[i] * whole[3, 1] + z[i] * whole[3, 2]) / length
                    dx[i] += v * whole[3, 0]
                    dy[i] += v * whole[3, 1]
                    dz[i] += v * whole[3, 2]
            for i in range(GROUP):
                if row[g, i] < 0 or (dx[i] == 0.0 and dy[i] == 0.0 and dz[i] == 0.0):
                    continue
                u = tangent[0, 0, i] * dx[i] + tangent[0, 1, i] * dy[i] + tangent[0, 2, i] * dz[i]
                v = tangent[1, 0, i] * dx[i] + tangent[1, 1, i] * dy[i] + tangent[1, 2, i] * dz[i]
                height = max(x[i] * dx[i] + y[i] * dy[i] + z[i] * dz[i], 0.0)  # of what is below the horizon: its rim
                scale = 1.0 / math.sqrt(max(u * u + v * v + height * height, 1e-300))
                _share_out(disc[i], side, u * scale, v * scale, red[i], green[i], blue[i])
        for i in range(GROUP):
            if row[g, i] < 0:
                continue
            for p in range(len(direction)):
                if not seen[p, g * GROUP + i]:
                    continue
                a, b, d = direction[p, 0], direction[p, 1], direction[p, 2]
                h = x[i] * a + y[i] * b + z[i] * d
                if h > 0.0:
                    u = tangent[0, 0, i] * a + tangent[0, 1, i] * b + tangent[0, 2, i] * d
                    v = tangent[1, 0, i] * a + tangent[1, 1, i] * b + tangent[1, 2, i] * d
                    h *= np.float64(seen[p, g * GROUP + i])
                    _share_out(disc[i], side, u, v, h * point_flux[p, 0], h * point_flux[p, 1], h * point_flux[p, 2])
            _multiply(factors, disc[i], out[row[g, i]])

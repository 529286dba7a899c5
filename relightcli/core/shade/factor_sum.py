"""Light of the factors of BRDFs at receivers, from clusters of the sky's light. [Sun 2007, sec. 4.1]

    I0(i, k) = integral of V_i U_k (n_i . w)+ L dw  ~  sum over groups g of U_k(w_ig) E_ig
    E_ig = sum over the clusters c of g of f_ic F_c g(n_i . w_c, r_c),    w_ig = their mean direction, weighted by E

in the frame of the receiver (`lobe_factors.axes_of`), f the visible fractions, F_c the flux, w_c the mean direction and
r_c half the side of a cluster, g(x, r) its cosine about the horizon (`transport.light_clusters`). A factor U is smooth
and known: where it is linear over a group the sum is as good as one over the clusters, and U is taken once for all of
them. So light of any map becomes light of the factors without transfer being stored for them.

A cluster that is larger than a group is in parts, which have its fractions. Directions are those of all colours
together. Nothing is added to what was there before: sums are float64 within a group, float32 over the groups.
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

LANES = 8  # factors that are summed at once


def factor_light(
    fractions: Fractions,
    receiver: NDArray[np.integer],
    light: LeafLight,
    cell: NDArray[np.int64],
    radius: NDArray[np.float64],
    start: NDArray[np.int64],
    table: NDArray[np.float32],
    threads: int = 1,
) -> NDArray[np.float32]:
    """I0 (n, K, 3) float32, radiance times sr sr^-1, at n receivers, rising indices.

    light: of e parts of clusters, flux (e, 3) and moment (e, 3, 3); cell (e,): the cluster of each in `fractions`;
    radius (e,): half their sides; start (p + 1,): the parts of every group; table (D, D, K): factors over the disc, as
    of `direct_model.LightFactors`.
    """
    count = table.shape[2]
    wide = widened(table)
    groups = len(fractions.place)
    row = np.full(groups * GROUP, -1, np.int32)
    row[receiver] = np.arange(len(receiver))
    row = row.reshape(groups, GROUP)
    used = np.flatnonzero((row >= 0).any(axis=1))
    total = light.flux.sum(axis=1)[:, None]
    mean = np.divide(light.moment.sum(axis=1), total, out=np.zeros((len(total), 3)), where=total != 0.0)
    weight = light.flux @ LUMINANCE
    out = np.zeros((len(receiver), count, 3), np.float32)

    def part(a: int, b: int) -> None:
        _sum(
            used[a:b], fractions.place, fractions.mixed, fractions.normal, row, start, cell, light.flux, weight, mean,
            radius, wide, out,
        )  # fmt: skip

    in_parts(part, len(used), threads)
    return out


def add_points(
    out: NDArray[np.float32],
    seen: Seen,
    points: Points,
    normal: NDArray[np.float32],
    receiver: NDArray[np.integer],
    table: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Adds to I0 (n, K, 3) of the receivers (n,) what P points give: seen (P, N) bool, or the visible part as float32;
    normal (N, 3) float32 unit; table as in `factor_light`."""
    wide = widened(table)
    in_parts(
        lambda a, b: _points(seen, points.direction, points.flux, normal, receiver[a:b], wide, out[a:b]),
        len(receiver),
        threads,
    )


def widened(table: NDArray[np.float32]) -> NDArray[np.float32]:
    """The factors (D, D, K), and zeros up to a multiple of LANES."""
    out = np.zeros((*table.shape[:2], -(-table.shape[2] // LANES) * LANES), np.float32)
    out[..., : table.shape[2]] = table
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _add_factors(table, x, y, red, green, blue, into):  # type: ignore[no-untyped-def]
    """Adds U(x, y) of all factors, times a colour, to into (3, K)."""
    i, j, fx, fy = place_on_disc(np.float32(x), np.float32(y), table.shape[0])
    w3 = fx * fy
    w1, w2 = fy - w3, fx - w3
    w0 = np.float32(1.0) - fx - w1
    c00, c01, c10, c11 = table[i, j], table[i, j + 1], table[i + 1, j], table[i + 1, j + 1]
    for first in range(0, table.shape[2], LANES):
        for lane in range(LANES):
            k = first + lane
            u = w0 * c00[k] + w1 * c01[k] + w2 * c10[k] + w3 * c11[k]
            into[0, k] += u * red
            into[1, k] += u * green
            into[2, k] += u * blue


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _sum(used, place, mixed, normal, row, start, cell, flux, weight, mean, radius, table, out):  # type: ignore[no-untyped-def]
    count = out.shape[1]
    sums = np.empty((6, GROUP))  # light by colour, and directions times luminance
    tangent = np.empty((2, 3, GROUP))
    found = np.empty((GROUP, 3, table.shape[2]), np.float32)
    whole = np.empty((4, 3))  # moment by colour and of luminance, of what all 64 see
    for g in used:
        x, y, z = normal[g, 0], normal[g, 1], normal[g, 2]
        for i in range(GROUP):
            s, t, _ = axes_of((x[i], y[i], z[i]))
            tangent[0, 0, i], tangent[0, 1, i], tangent[0, 2, i] = s
            tangent[1, 0, i], tangent[1, 1, i], tangent[1, 2, i] = t
        found[:] = np.float32(0.0)
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
                seen = mixed[q]
                r, steep, w = radius[e], 0.25 / radius[e], weight[e] / 255.0
                fr, fg, fb = flux[e, 0] / 255.0, flux[e, 1] / 255.0, flux[e, 2] / 255.0
                for i in range(GROUP):
                    h = x[i] * a + y[i] * b + z[i] * d
                    low = max(h + r, 0.0)
                    v = np.float64(seen[i]) * (h if h >= r else low * low * steep)
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
                _add_factors(
                    table, u * scale, v * scale, np.float32(red[i]), np.float32(green[i]), np.float32(blue[i]), found[i]
                )
        for i in range(GROUP):
            if row[g, i] >= 0:
                for k in range(count):
                    for c in range(3):
                        out[row[g, i], k, c] = found[i, c, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _points(seen, direction, flux, normal, receiver, table, out):  # type: ignore[no-untyped-def]
    found = np.empty((3, table.shape[2]), np.float32)
    for j in range(len(receiver)):
        i = receiver[j]
        s, t, n = axes_of((np.float64(normal[i, 0]), np.float64(normal[i, 1]), np.float64(normal[i, 2])))
        found[:] = np.float32(0.0)
        for p in range(len(direction)):
            if not seen[p, i]:
                continue
            x, y, z = direction[p, 0], direction[p, 1], direction[p, 2]
            height = n[0] * x + n[1] * y + n[2] * z
            if not height > 0.0:
                continue
            light = height * np.float64(seen[p, i])
            _add_factors(
                table,
                s[0] * x + s[1] * y + s[2] * z,
                t[0] * x + t[1] * y + t[2] * z,
                np.float32(light * flux[p, 0]),
                np.float32(light * flux[p, 1]),
                np.float32(light * flux[p, 2]),
                found,
            )
        for k in range(out.shape[1]):
            for c in range(3):
                out[j, k, c] += found[c, k]

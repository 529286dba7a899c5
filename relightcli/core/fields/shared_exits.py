"""Exit radiance of glossy points per light at the proxies, kept short.

A point takes the light of proxy k by its weight w_k, so nearly all that it sends is a product: with e_b,kj from
`self_transfer` and E_bj its sum over the proxies, which is what it sends under light that is the same at all of them,

    e_b,kj = w_k E_bj + d_b,kj.

d is what the object's own reflections make of the weights' differences from point to point; a few combinations of
lights span it:

    d_b,kj ~ sum over r of c_br Q_r,kj.

Q are lights themselves: those that are furthest from a combination of those before, one after the other, until what is
left of d is LEFT of e, in the root of the sum of squares. A row of 16 m numbers becomes one of 16 + r.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.compress.span import span
from relightcli.core.fields.body import Body, fill_basis
from relightcli.core.fields.sampling import Found

LEFT = 3e-3  # in squares a fortieth of what the compressed transfer of a glossy object may err by
_ROUND_OFF = 3e-7  # of float32 exits: less is nothing
_LANES = 8  # lights are chosen in groups that fill a vector


class SharedExits(NamedTuple):
    """weight (P, m) float32; row (P, terms, N C + r) float32: E_b, then c_b; basis (r, m N C) float32: Q."""

    weight: NDArray[np.float32]
    row: NDArray[np.float32]
    basis: NDArray[np.float32]

    @property
    def lights(self) -> int:
        """m N C."""
        return self.basis.shape[1]


def share_exits(exits: NDArray[np.float32], weight: NDArray[np.float64], left: float = LEFT) -> SharedExits:
    """Of exits (P, terms, m N C), lights k, j, colour, and the weights (P, m) of the proxies; left: see LEFT.

    No linear algebra library is asked: the bytes hang on nothing else.
    """
    points, terms, lights = exits.shape
    proxies = weight.shape[1]
    apart = exits.reshape(points, terms, proxies, lights // proxies)
    whole = apart.sum(axis=2, dtype=np.float64)
    rest = np.ascontiguousarray(apart - weight[:, None, :, None] * whole[:, :, None, :], np.float32)
    rest = rest.reshape(points * terms, lights)
    norm2 = float(np.einsum("ptk,ptk->", exits, exits, dtype=np.float64))
    chosen, basis = span(_gram(rest), max(left, _ROUND_OFF) ** 2 * norm2, group=_LANES)
    row = np.concatenate([whole.astype(np.float32), rest[:, chosen].reshape(points, terms, -1)], axis=2)
    return SharedExits(weight.astype(np.float32), row, basis.astype(np.float32))


@njit(cache=True)
def _gram(rows: Any) -> Any:
    """Products of all columns with each other, float64."""
    n = rows.shape[1]
    out = np.zeros((n, n))
    own = np.empty(n)
    for r in range(len(rows)):
        own[:] = rows[r]
        if not own.any():
            continue
        for i in range(n):
            for j in range(i, n):
                out[i, j] += own[i] * own[j]
    for i in range(n):
        out[i:, i] = out[i, i:]
    return out


def gather_shared(
    found: Found, harmonics: NDArray[np.float32], exits: SharedExits, body: Body, frames: NDArray[np.float64]
) -> NDArray[np.float32]:
    """`sampling.gather` of shared exits: (S, N, m N C) float32."""
    samples, n = len(found.weight), harmonics.shape[1]
    out = np.zeros((samples, n, exits.lights), np.float32)
    _gather(found, harmonics, exits.weight, exits.row, exits.basis, body.lobe, frames, body.order, out)
    return out


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _gather(found, harmonics, weight, row, basis, lobe, frames, order, out):  # type: ignore[no-untyped-def]
    terms, columns, proxies = row.shape[1], row.shape[2], weight.shape[1]
    width = columns - len(basis)
    lights = proxies * width
    g, w = np.zeros(terms), np.empty(3)
    own = np.empty((3, columns), np.float32)
    seen = np.zeros((4, lights + len(basis)), np.float32)
    shape = np.zeros((4, harmonics.shape[1]), np.float32)
    total = np.empty((harmonics.shape[1], lights + len(basis)), np.float32)
    one, two, three = own[0], own[1], own[2]
    p0, p1, p2, p3 = seen[0], seen[1], seen[2], seen[3]
    for s in range(len(out)):
        total[:] = np.float32(0.0)
        held, last = 0, found.start[s + 1]
        while last > found.start[s] and found.point[last - 1, 0] < 0:
            last -= 1
        for r in range(found.start[s], last):
            a, b, c = found.point[r, 0], found.point[r, 1], found.point[r, 2]
            if a < 0:
                continue
            for x in range(3):
                w[x] = -found.direction[r, x]
            own[:] = np.float32(0.0)
            for corner in range(3):
                p = found.point[r, corner]
                fill_basis(lobe, frames[p], w, order, g)
                share, mine = found.share[r, corner], own[corner]
                for t in range(0, terms - 3, 4):
                    d, e = np.float32(share * g[t]), np.float32(share * g[t + 1])
                    f, h = np.float32(share * g[t + 2]), np.float32(share * g[t + 3])
                    u, v, y, z = row[p, t], row[p, t + 1], row[p, t + 2], row[p, t + 3]
                    for j in range(columns):
                        mine[j] += d * u[j] + e * v[j] + f * y[j] + h * z[j]
                for t in range(terms - terms % 4, terms):
                    e, u = np.float32(share * g[t]), row[p, t]
                    for j in range(columns):
                        mine[j] += e * u[j]
            radiance = seen[held]
            for k in range(proxies):
                e, f, h, part = weight[a, k], weight[b, k], weight[c, k], radiance[k * width : (k + 1) * width]
                for j in range(width):
                    part[j] = e * one[j] + f * two[j] + h * three[j]
            for j in range(len(basis)):
                radiance[lights + j] = one[width + j] + two[width + j] + three[width + j]
            for i in range(harmonics.shape[1]):
                shape[held, i] = np.float32(found.weight[s]) * harmonics[r, i]
            held += 1
            if held < 4 and r + 1 < last:
                continue
            shape[held:] = np.float32(0.0)
            held = 0
            for i in range(harmonics.shape[1]):
                sums = total[i]
                d, e, f, h = shape[0, i], shape[1, i], shape[2, i], shape[3, i]
                for k in range(len(sums)):
                    sums[k] += d * p0[k] + e * p1[k] + f * p2[k] + h * p3[k]
        for i in range(harmonics.shape[1]):
            sums = out[s, i]
            sums[:] = total[i, :lights]
            for j in range(len(basis)):
                e, light = total[i, lights + j], basis[j]
                for k in range(lights):
                    sums[k] += e * light[k]

"""Irradiance from clusters of lights: E_i = sum_k f_ik F_k g(n_i . m_k / F_k, r_k), per colour, f the visible fraction
of cluster k at receiver i, F_k the flux and m_k the moment of the light that it holds, r_k half its side, and g the
cosine as light about the horizon has it (`core.transport.light_clusters`).

Receivers are taken 64 at a time. Where all 64 see nothing of a cluster it costs nothing; where all see all of it, its
moment joins a sum that is the same for the 64 (it stands above all their horizons); only what is mixed is kept in
memory, a byte per receiver. Sums are float64: a sun of 1e6 that is added and taken away again leaves the digits of a
sky of 1e-3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.parts import in_parts

GROUP = 64
FEW = 16  # clusters that one thread changes sooner than several start
NONE, ALL = -1, -2
ALIKE = 1e-3  # how far a colour's mean direction may be from that of all for one cosine to do


class _Flat(NamedTuple):
    """Light of some clusters as kernels read it.

    light (k, 3, 5): per colour the moment, r F, and 1 / (4 r F), 0 where there is no light; alike (k,): whether mean
    (k, 3), the moment over the flux of all colours, does for each; flux (k, 3); radius (k,).
    """

    light: NDArray[np.float64]
    alike: NDArray[np.bool_]
    mean: NDArray[np.float64]
    flux: NDArray[np.float64]
    radius: NDArray[np.float64]


class Fractions:
    """Visible fractions (m, N) of m clusters at N receivers, packed.

    place (G, m) int32: row of `mixed` (Q, 64) uint8 with the fractions of a group of 64 receivers in steps of 1/255,
    or NONE or ALL where it is 0 or 1 at all of them.
    """

    def __init__(
        self, columns: Iterable[NDArray[np.uint8]], normal: NDArray[np.float32], radius: NDArray[np.float64]
    ) -> None:
        """columns: the fractions (m, n) of runs of receivers, n a multiple of 64 but for the last; normal (N, 3) unit;
        radius (m,): r."""
        places, parts, count = [], [], 0
        for column in columns:
            place, mixed = _pack(column, count)
            places.append(place)
            parts.append(mixed)
            count += len(mixed)
        self.place = np.concatenate(places)
        self.mixed = np.concatenate(parts)
        groups = len(self.place)
        padded = np.zeros((groups * GROUP, 3))
        padded[: len(normal)] = normal
        self.normal = np.ascontiguousarray(padded.reshape(groups, GROUP, 3).transpose(0, 2, 1))
        self.count = len(normal)
        self.radius = radius

    def sum(self, light: LeafLight, threads: int) -> NDArray[np.float64]:
        """Irradiance by groups, (G, 3, 64) float64."""
        out = np.zeros((len(self.place), 3, GROUP))
        every = np.arange(len(light.flux))
        self._add(out, every, self._flat(light, every), threads)
        return out

    def change(
        self, out: NDArray[np.float64], clusters: NDArray[np.int64], old: LeafLight, new: LeafLight, threads: int
    ) -> None:
        """Adds to irradiance (G, 3, 64) what it gains when the light of some clusters (k,) goes from old to new.

        old, new: of these clusters alone.
        """
        twice = np.concatenate([clusters, clusters])
        light = LeafLight(np.concatenate([-old.flux, new.flux]), np.concatenate([-old.moment, new.moment]))
        self._add(out, twice, self._flat(light, twice), threads)

    def _add(self, out: NDArray[np.float64], clusters: NDArray[np.int64], light: _Flat, threads: int) -> None:
        in_parts(
            lambda a, b: _add_all(self.place[a:b], self.mixed, self.normal[a:b], clusters, *light, out[a:b]),
            len(out),
            threads if len(clusters) > FEW else 1,
        )

    def by_receiver(self, groups: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) of values by groups, (G, 3, 64)."""
        return np.ascontiguousarray(groups.transpose(0, 2, 1)).reshape(-1, 3)[: self.count]

    def rounded(self, groups: NDArray[np.float64], more: NDArray[np.float64] | None) -> NDArray[np.float32]:
        """(N, 3) float32 of values by groups plus `more` (N, 3)."""
        out = np.empty((self.count, 3), np.float32)
        _round(groups, np.zeros((0, 3)) if more is None else more, out)
        return out

    def by_group(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(G, 3, 64) of values (N, 3)."""
        padded = np.zeros((len(self.place) * GROUP, 3))
        padded[: self.count] = values
        return np.ascontiguousarray(padded.reshape(-1, GROUP, 3).transpose(0, 2, 1))

    def _flat(self, light: LeafLight, chosen: NDArray[np.int64]) -> _Flat:
        flux, moment, radius = *light, self.radius[chosen]
        reach = flux * radius[:, None]
        steep = np.divide(0.25, reach, out=np.zeros_like(reach), where=reach != 0.0)
        total = flux.sum(axis=1)[:, None]
        mean = np.divide(moment.sum(axis=1), total, out=np.zeros((len(chosen), 3)), where=total != 0.0)
        apart = np.abs(moment - flux[:, :, None] * mean[:, None, :]).max(axis=2)
        alike = (apart <= ALIKE * np.abs(flux)).all(axis=1) & (radius > 0.0)
        return _Flat(np.concatenate([moment, reach[..., None], steep[..., None]], axis=2), alike, mean, flux, radius)

    def of(self, cluster: int) -> NDArray[np.uint8]:
        """One cluster's fractions, (N,), in steps of 1/255."""
        place = self.place[:, cluster]
        out = np.zeros((len(place), GROUP), np.uint8)
        out[place == ALL] = 255
        out[place >= 0] = self.mixed[place[place >= 0]]
        return out.reshape(-1)[: self.count]


def _pack(column: NDArray[np.uint8], first: int, whole: bool = True) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Places, counted from `first`, and what is mixed; whole: groups that are full throughout are no more than ALL."""
    groups = -(-column.shape[1] // GROUP)
    place = np.empty((groups, len(column)), np.int32)
    count = _find(column, place, whole)
    mixed = np.zeros((count, GROUP), np.uint8)
    _keep(column, place, mixed, first)
    return place, mixed


@njit(cache=True, nogil=True)
def _find(column, place, whole):  # type: ignore[no-untyped-def]
    count = 0
    n = column.shape[1]
    for k in range(len(column)):
        for g in range(len(place)):
            low, high = np.uint8(255), np.uint8(0)
            for i in range(g * GROUP, min(g * GROUP + GROUP, n)):
                low, high = min(low, column[k, i]), max(high, column[k, i])
            if high == 0:
                place[g, k] = NONE
            elif low == 255 and whole:
                place[g, k] = ALL
            else:
                place[g, k] = 0
                count += 1
    return count


@njit(cache=True, nogil=True)
def _keep(column, place, mixed, first):  # type: ignore[no-untyped-def]
    """Group by group, so that a sum over all clusters reads straight on."""
    count = 0
    n = column.shape[1]
    for g in range(len(place)):
        for k in range(len(column)):
            if place[g, k] == 0:
                for i in range(g * GROUP, min(g * GROUP + GROUP, n)):
                    mixed[count, i - g * GROUP] = column[k, i]
                place[g, k] = first + count
                count += 1


@njit(cache=True, nogil=True)
def _round(groups, more, out):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        for c in range(3):
            value = groups[i // GROUP, c, i % GROUP]
            if len(more):
                value += more[i, c]
            out[i, c] = np.float32(value)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _spread(height, reach, steep):  # type: ignore[no-untyped-def]
    """F g of a moment's height n . m, with r F and 1 / (4 r F); of light that is taken away, F < 0, as well."""
    side = 1.0 if reach >= 0.0 else -1.0
    low = max(side * (height + reach), 0.0)
    return height if side * (height - reach) >= 0.0 else low * low * steep


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _add_all(place, mixed, normal, clusters, light, alike, mean, flux, radius, out):  # type: ignore[no-untyped-def]
    whole, sums, own = np.empty((3, 3)), np.empty((3, GROUP)), np.empty(len(clusters), np.int32)
    for g in range(len(place)):
        some = False
        for j in range(len(clusters)):  # without a branch: places are far apart
            own[j] = place[g, clusters[j]]
            some |= own[j] != NONE
        if not some:
            continue
        whole[:] = 0.0
        sums[:] = 0.0
        x, y, z = normal[g, 0], normal[g, 1], normal[g, 2]
        red, green, blue = sums[0], sums[1], sums[2]
        for j in range(len(clusters)):
            p = own[j]
            if p == NONE:
                continue
            if p == ALL:
                for c in range(3):
                    for k in range(3):
                        whole[c, k] += light[j, c, k]
                continue
            row = mixed[p]
            if alike[j]:
                a, b, d, r, steep = mean[j, 0], mean[j, 1], mean[j, 2], radius[j], 0.25 / radius[j]
                fr, fg, fb = flux[j, 0], flux[j, 1], flux[j, 2]
                for i in range(GROUP):
                    h = x[i] * a + y[i] * b + z[i] * d
                    low = max(h + r, 0.0)
                    seen = np.float64(row[i]) * (h if h >= r else low * low * steep)
                    red[i] += fr * seen
                    green[i] += fg * seen
                    blue[i] += fb * seen
                continue
            for c in range(3):
                a, b, d, reach, steep = light[j, c, 0], light[j, c, 1], light[j, c, 2], light[j, c, 3], light[j, c, 4]
                into = sums[c]
                for i in range(GROUP):
                    into[i] += np.float64(row[i]) * _spread(x[i] * a + y[i] * b + z[i] * d, reach, steep)
        for c in range(3):
            into = out[g, c]
            for i in range(GROUP):
                into[i] += sums[c, i] / 255.0 + (x[i] * whole[c, 0] + y[i] * whole[c, 1] + z[i] * whole[c, 2])


class Lobes:
    """Transfer (m, n) by specular lobes from m clusters to n receivers, packed like `Fractions`: place (G, m), the
    steps (Q, 64) uint8 and a step's size (Q,) float32 for each group that has any."""

    def __init__(self, steps: NDArray[np.uint8], scale: NDArray[np.float32]) -> None:
        """steps (m, n); scale (m, ceil(n / 64))."""
        self.place, self.mixed = _pack(steps, 0, whole=False)
        self.count = steps.shape[1]
        self.scale = np.zeros(len(self.mixed), np.float32)
        group, cluster = np.nonzero(self.place >= 0)
        self.scale[self.place[group, cluster]] = scale[cluster, group]

    def dark(self) -> NDArray[np.float64]:
        """Specular light by groups (G, 3, 64) float64, of no light yet."""
        return np.zeros((len(self.place), 3, GROUP))

    def add(
        self, out: NDArray[np.float64], clusters: NDArray[np.int64], flux: NDArray[np.float64], threads: int
    ) -> None:
        """Adds to specular light (G, 3, 64), without the specular colour, that of some clusters with flux (k, 3)."""
        in_parts(
            lambda a, b: _sum_lobes(self.place[a:b], self.mixed, self.scale, clusters, flux, out[a:b]),
            len(out),
            threads if len(clusters) > FEW else 1,
        )

    def put(
        self,
        groups: NDArray[np.float64],
        more: NDArray[np.float64] | None,
        rows: NDArray[np.int64],
        colour: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Specular light by groups (G, 3, 64) plus `more` (n, 3), not below 0, times the colour (N, 3) of the `rows`
        (n,) of all; (N, 3)."""
        out = np.zeros(colour.shape, np.float32)
        _put(groups, np.zeros((0, 3)) if more is None else more, rows, colour, out)
        return out


@njit(cache=True, nogil=True)
def _put(groups, more, rows, colour, out):  # type: ignore[no-untyped-def]
    for j in range(len(rows)):
        for c in range(3):
            value = groups[j // GROUP, c, j % GROUP]
            if len(more):
                value += more[j, c]
            out[rows[j], c] = np.float32(max(value, 0.0)) * colour[rows[j], c]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _sum_lobes(place, mixed, scale, clusters, flux, out):  # type: ignore[no-untyped-def]
    rows, weight = np.empty(4, np.int64), np.empty((4, 3))
    for g in range(len(place)):
        red, green, blue = out[g, 0], out[g, 1], out[g, 2]
        held = 0
        for j in range(len(clusters)):
            p = place[g, clusters[j]]
            if p < 0:
                continue
            step = np.float64(scale[p])
            rows[held] = p
            weight[held, 0], weight[held, 1], weight[held, 2] = step * flux[j, 0], step * flux[j, 1], step * flux[j, 2]
            held += 1
            if held < 4:  # four at a time: fewer passes over the sums
                continue
            held = 0
            a, b, c, d = mixed[rows[0]], mixed[rows[1]], mixed[rows[2]], mixed[rows[3]]
            a0, a1, a2 = weight[0]
            b0, b1, b2 = weight[1]
            c0, c1, c2 = weight[2]
            d0, d1, d2 = weight[3]
            for i in range(GROUP):
                x, y, z, w = np.float64(a[i]), np.float64(b[i]), np.float64(c[i]), np.float64(d[i])
                red[i] += (x * a0 + y * b0) + (z * c0 + w * d0)
                green[i] += (x * a1 + y * b1) + (z * c1 + w * d1)
                blue[i] += (x * a2 + y * b2) + (z * c2 + w * d2)
        for k in range(held):
            row = mixed[rows[k]]
            x, y, z = weight[k]
            for i in range(GROUP):
                red[i] += np.float64(row[i]) * x
                green[i] += np.float64(row[i]) * y
                blue[i] += np.float64(row[i]) * z

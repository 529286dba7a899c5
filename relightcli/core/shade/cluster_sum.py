"""Irradiance from clusters of lights: E_i = sum_k f_ik F_k g(n_i . m_k / F_k, r_k), per colour, f the visible fraction
of cluster k at receiver i, F_k the flux and m_k the moment of the light that it holds, r_k half its side, and g the
cosine as light about the horizon has it (`core.transport.light_clusters`).

Receivers are taken 64 at a time. Where all 64 see nothing of a cluster it costs nothing; where all see all of it, its
moment joins a sum that is the same for the 64 (it stands above all their horizons); only what is mixed is kept in
memory, a byte per receiver. Sums are float64: a sun of 1e6 that is added and taken away again leaves the digits of a
sky of 1e-3.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.lights.leaf_light import LeafLight

GROUP = 64
FEW = 16  # clusters that one thread changes sooner than several start
NONE, ALL = -1, -2


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
        flat = self._flat(light, slice(None))
        _in_parts(
            lambda a, b: _sum_all(self.place[a:b], self.mixed, self.normal[a:b], flat, out[a:b]), len(out), threads
        )
        return out

    def change(
        self, out: NDArray[np.float64], clusters: NDArray[np.int64], old: LeafLight, new: LeafLight, threads: int
    ) -> None:
        """Adds to irradiance (G, 3, 64) what it gains when the light of some clusters (k,) goes from old to new."""
        before, after = self._flat(old, clusters), self._flat(new, clusters)
        _in_parts(
            lambda a, b: _change(self.place[a:b], self.mixed, self.normal[a:b], clusters, before, after, out[a:b]),
            len(out),
            threads if len(clusters) > FEW else 1,
        )

    def by_receiver(self, groups: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) of values by groups, (G, 3, 64)."""
        return np.ascontiguousarray(groups.transpose(0, 2, 1)).reshape(-1, 3)[: self.count]

    def by_group(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(G, 3, 64) of values (N, 3)."""
        padded = np.zeros((len(self.place) * GROUP, 3))
        padded[: self.count] = values
        return np.ascontiguousarray(padded.reshape(-1, GROUP, 3).transpose(0, 2, 1))

    def _flat(self, light: LeafLight, chosen: Any) -> NDArray[np.float64]:
        """Per cluster and colour: moment, r F, and 1 / (4 r F), 0 where there is no light: (k, 3, 5)."""
        reach = light.flux[chosen] * self.radius[chosen][:, None]
        steep = np.divide(0.25, reach, out=np.zeros_like(reach), where=reach > 0.0)
        return np.concatenate([light.moment[chosen], reach[..., None], steep[..., None]], axis=2)

    def of(self, cluster: int) -> NDArray[np.uint8]:
        """One cluster's fractions, (N,), in steps of 1/255."""
        place = self.place[:, cluster]
        out = np.zeros((len(place), GROUP), np.uint8)
        out[place == ALL] = 255
        out[place >= 0] = self.mixed[place[place >= 0]]
        return out.reshape(-1)[: self.count]


def _in_parts(work, count: int, threads: int) -> None:  # type: ignore[no-untyped-def]
    if threads <= 1:
        work(0, count)
        return
    cuts = np.unique(np.linspace(0, count, 4 * threads + 1).astype(int))
    with ThreadPoolExecutor(threads) as pool:
        for job in [pool.submit(work, a, b) for a, b in itertools.pairwise(cuts)]:
            job.result()


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


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _spread(height, reach, steep):  # type: ignore[no-untyped-def]
    """F g of a moment's height n . m, with r F and 1 / (4 r F)."""
    low = max(height + reach, 0.0)
    return height if height >= reach else low * low * steep


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _sum_all(place, mixed, normal, light, out):  # type: ignore[no-untyped-def]
    whole = np.empty((3, 3))
    for g in range(len(place)):
        whole[:] = 0.0
        x, y, z = normal[g, 0], normal[g, 1], normal[g, 2]
        for k in range(place.shape[1]):
            p = place[g, k]
            if p == NONE:
                continue
            for c in range(3):
                a, b, d, reach, steep = light[k, c, 0], light[k, c, 1], light[k, c, 2], light[k, c, 3], light[k, c, 4]
                if p == ALL:
                    whole[c, 0] += a
                    whole[c, 1] += b
                    whole[c, 2] += d
                    continue
                row, into = mixed[p], out[g, c]
                for i in range(GROUP):
                    into[i] += np.float64(row[i]) * _spread(x[i] * a + y[i] * b + z[i] * d, reach, steep)
        for c in range(3):
            into = out[g, c]
            for i in range(GROUP):
                into[i] = into[i] / 255.0 + x[i] * whole[c, 0] + y[i] * whole[c, 1] + z[i] * whole[c, 2]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _change(place, mixed, normal, clusters, old, new, out):  # type: ignore[no-untyped-def]
    for g in range(len(place)):
        x, y, z = normal[g, 0], normal[g, 1], normal[g, 2]
        for j in range(len(clusters)):
            p = place[g, clusters[j]]
            if p == NONE:
                continue
            for c in range(3):
                a, b, d, reach, steep = old[j, c, 0], old[j, c, 1], old[j, c, 2], old[j, c, 3], old[j, c, 4]
                e, f, h, now, sharp = new[j, c, 0], new[j, c, 1], new[j, c, 2], new[j, c, 3], new[j, c, 4]
                into = out[g, c]
                if p == ALL:
                    for i in range(GROUP):
                        into[i] += x[i] * (e - a) + y[i] * (f - b) + z[i] * (h - d)
                else:
                    row = mixed[p]
                    for i in range(GROUP):
                        before = _spread(x[i] * a + y[i] * b + z[i] * d, reach, steep)
                        after = _spread(x[i] * e + y[i] * f + z[i] * h, now, sharp)
                        into[i] += np.float64(row[i]) / 255.0 * (after - before)


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

    def sum(self, clusters: NDArray[np.int64], flux: NDArray[np.float64], threads: int) -> NDArray[np.float64]:
        """Specular light (n, 3) float64 of some clusters with flux (k, 3), without the specular colour."""
        out = np.zeros((len(self.place), 3, GROUP))
        _in_parts(
            lambda a, b: _sum_lobes(self.place[a:b], self.mixed, self.scale, clusters, flux, out[a:b]),
            len(out),
            threads,
        )
        return np.ascontiguousarray(out.transpose(0, 2, 1)).reshape(-1, 3)[: self.count]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _sum_lobes(place, mixed, scale, clusters, flux, out):  # type: ignore[no-untyped-def]
    for g in range(len(place)):
        for j in range(len(clusters)):
            p = place[g, clusters[j]]
            if p < 0:
                continue
            row = mixed[p]
            for c in range(3):
                step = np.float64(scale[p]) * flux[j, c]
                into = out[g, c]
                for i in range(GROUP):
                    into[i] += np.float64(row[i]) * step

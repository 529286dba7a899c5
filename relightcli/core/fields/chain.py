"""Light at a point, through what stands before it: the entities from far to near. [Pan 2007, Algorithm 1]

    L_q = I_1 + V_1 * (I_2 + V_2 * ( ... (I_E + V_E * L_far)))

I_e is the light that entity e sends to q, V_e what passes it (object occlusion field), * the cut triple product, the
nearest entity first, L_far the sky. The paper multiplies the V up instead and adds V_1 * V_2 * .. * I_e as it goes; cut
products are not associative, so the two differ by what is cut. This order costs three products an entity instead of
four, and is bounded: a product by V_e is a matrix whose eigenvalues lie between the least and greatest value of V_e.
With V_e windowed (`core.sphere.window`) they lie in [0, 1] and no number of occluders makes light grow.

Entities that give back what they hide, I_e = 1 - V_e, telescope: L_far = 1 gives L_q = 1 whatever is cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.fields.entities import Entity, Lookup, look_up, turn_together
from relightcli.core.fields.sites import Between
from relightcli.core.parts import in_parts
from relightcli.core.sphere.triple_product import coefficients
from relightcli.core.sphere.window import window

EVEN = math.sqrt(4.0 * math.pi)  # coefficient of y_0 of the function 1
LANES = 128
STEP = LANES + 16  # from one coefficient's lanes to the next: powers of two would share few places of the cache


def open_rows(
    entities: list[Entity], lookup: Lookup, order: int, windowed: float = 0.0, threads: int = 1
) -> NDArray[np.float32]:
    """Rows (samples, 4, N) float32 in the world's frame, of the samples that are read: what passes the entity as the
    sample sees it, and the radiance that it sends in three colours. Reflections are still missing.

    windowed: strength of the window, 0 (none) to 1.
    """
    n = order * order
    rows = np.zeros((len(lookup.sample), 4, n), np.float32)
    rows[:, 0, 0] = EVEN
    turn_together(entities, order)

    def put(e: int) -> None:
        own, part = entities[e].own, lookup.part(e)
        which = lookup.sample[part]
        turn = (entities[e].turn(order) * window(order, windowed)).T.astype(np.float32, order="C")
        if own.occlusion is not None:
            rows[part, 0] = _times(own.occlusion[which], turn)
        if own.radiance is not None:
            sent = np.ascontiguousarray(own.radiance[which].transpose(0, 2, 1))
            rows[part, 1:] = _times(sent.reshape(-1, n), turn).reshape(sent.shape)

    in_parts(lambda a, b: _each(put, a, b), len(entities), threads)
    return rows


def put_reflections(
    rows: NDArray[np.float32],
    entities: list[Entity],
    lookup: Lookup,
    lights: list[NDArray[np.float32]],
    windowed: float = 0.0,
    threads: int = 1,
    wanted: NDArray[np.bool_] | None = None,
) -> None:
    """Puts what the entities reflect of lights (m, 3, N), in the world's frame, at each one's proxies into the rows:
    once for every sample, however many points read it; wanted (T,): into these rows only. [Pan 2007, Eq. 11]"""
    order = math.isqrt(rows.shape[2])

    def put(e: int) -> None:
        transfer, part = entities[e].own.transfer, lookup.part(e)
        if transfer is None:
            return
        turn = entities[e].turn(order)
        which = lookup.sample[part]
        own = slice(None) if wanted is None else np.flatnonzero(wanted[part])
        seen = transfer.reflect(_times_each(lights[e], turn.astype(np.float32)), which[own])
        back = (turn * window(order, windowed)).T.astype(np.float32, order="C")
        rows[part][own, 1:] = _times(seen.reshape(-1, order * order), back).reshape(seen.shape)

    in_parts(lambda a, b: _each(put, a, b), len(entities), threads)


def _times_each(values: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    flat = np.ascontiguousarray(values, np.float32).reshape(-1, values.shape[-1])
    out: NDArray[np.float32] = _times(flat, matrix).reshape(values.shape)
    return out


@njit(cache=True, nogil=True, fastmath={"contract"})
def _times(values, matrix):  # type: ignore[no-untyped-def]
    """values (k, N) times matrix (N, N): a library's threads would stand in the way of ours."""
    n = values.shape[1]
    out = np.zeros(values.shape, np.float32)
    for r in range(len(values)):
        own, sums = values[r], out[r]
        for i in range(0, n - n % 4, 4):
            p, q, v, w = own[i], own[i + 1], own[i + 2], own[i + 3]
            a, b, c, d = matrix[i], matrix[i + 1], matrix[i + 2], matrix[i + 3]
            for j in range(n):
                sums[j] += p * a[j] + q * b[j] + v * c[j] + w * d[j]
        for i in range(n - n % 4, n):
            p, a = own[i], matrix[i]
            for j in range(n):
                sums[j] += p * a[j]
    return out


def _each(work: Callable[[int], None], start: int, stop: int) -> None:
    for e in range(start, stop):
        work(e)


def incident(
    entities: list[Entity],
    points: NDArray[np.floating],
    skip: NDArray[np.int32],
    sky: NDArray[np.floating],
    lights: list[NDArray[np.float32]],
    windowed: float = 0.0,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Light (n, 3, N) float32 at points (n, 3) from a sky (3, N), or one for each point, and from all entities but
    number skip (n,), with the lights at their proxies (see `bounce.settle`)."""
    order = math.isqrt(np.shape(sky)[-1])
    lookup = look_up(entities, points, skip, threads)
    rows = open_rows(entities, lookup, order, windowed, threads)
    put_reflections(rows, entities, lookup, lights, windowed, threads)
    return light_at(lookup, rows, sky, threads)


def light_at(
    lookup: Lookup,
    rows: NDArray[np.float32],
    far: NDArray[np.floating],
    threads: int = 1,
    share: NDArray[np.float32] | None = None,
    spread: Between | None = None,
    merged: float = 0.0,
    alone: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """L_q (n, 3, N) float32 in the world's frame; far (3, N), or (n, 3, N), is what comes from behind all entities.

    share (n, E): of each entity, what nothing else hides; None: all of it
    spread: far (S, 3, N) is known at S sites, between which the points lie
    merged: neighbours in the order that together hide no more than this of all directions count as one entity, that
        hides what both do. Whatever lies behind both is then darkened by N a b at most, a and b what each hides, as if
        they lay side by side; up to 1 / N the sum hides nothing twice as strongly as an entity can.
    alone (E,): entities that are never merged: a small lamp is not hidden in part
    """
    count, n = len(lookup.place), rows.shape[2]
    behind = np.ascontiguousarray(far, np.float32).reshape(-1, 3, n)
    out = np.empty((count, 3, n), np.float32)
    terms = _terms(math.isqrt(n))
    flat = rows.reshape(len(rows), 4 * n)
    part_of = np.ones((1, lookup.place.shape[1]), np.float32) if share is None else share
    site, mix = (np.zeros((1, 1), np.int64), np.ones((1, 1), np.float32)) if spread is None else spread
    single = np.zeros(lookup.place.shape[1], np.bool_) if alone is None else alone
    for_all = spread is None and len(behind) == 1

    def part(a: int, b: int) -> None:
        p, q = a * LANES, min(b * LANES, count)
        own = behind if for_all or spread is not None else behind[p:q]
        look = lookup.place[p:q], lookup.weight[p:q], lookup.nearest[p:q]
        shares = part_of if share is None else part_of[p:q]
        sites = (site, mix) if spread is None else (site[p:q], mix[p:q])
        _chain(*look, shares, flat, own, spread is not None, *sites, merged, single, *terms, out[p:q])

    # Whole groups of lanes: a few points fill no lanes when they are split.
    groups = -(-count // LANES)
    in_parts(part, groups, threads if groups > 32 else 1)
    return out


def passing(lookup: Lookup, rows: NDArray[np.float32], threads: int = 1, merged: float = 0.0) -> NDArray[np.float32]:
    """What all entities together let pass of even light of radiance 1, (n, N) float32; merged: see `light_at`."""
    dark = rows
    if rows[:, 1:].any():
        dark = rows.copy()
        dark[:, 1:] = 0.0
    even = np.zeros((3, rows.shape[2]))
    even[0, 0] = EVEN
    return light_at(lookup, dark, even, threads, merged=merged)[:, 0]


class _Terms(NamedTuple):
    """The coefficients of products, two of the same k and j together, k slowest: those of k, filled up to a multiple of
    four pairs, are start[k] to start[k + 1]; i (T, 2), j (T,): where the factors' lanes begin; value (T, 2)."""

    start: NDArray[np.int64]
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    value: NDArray[np.float32]


@lru_cache(maxsize=8)
def _terms(order: int) -> _Terms:
    table = coefficients(order)
    pairs: list[list[tuple[int, list[tuple[int, float]]]]] = [[] for _ in range(order**2)]
    for k, j in sorted(set(zip(table.k.tolist(), table.j.tolist(), strict=True))):
        own = np.flatnonzero((table.k == k) & (table.j == j))
        terms = [(int(table.i[t]), float(table.value[t])) for t in own] + [(0, 0.0)] * (len(own) % 2)
        pairs[k] += [(j, terms[t : t + 2]) for t in range(0, len(terms), 2)]
    filled = [own + [(0, [(0, 0.0)] * 2)] * (-len(own) % 4) for own in pairs]
    start = np.cumsum([0, *map(len, filled)], dtype=np.int64)
    flat = [pair for own in filled for pair in own]
    i = np.array([[STEP * factor for factor, _ in terms] for _, terms in flat], np.int64)
    value = np.array([[number for _, number in terms] for _, terms in flat], np.float32)
    return _Terms(start, i, np.array([3 * STEP * j for j, _ in flat], np.int64), value)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _chain(  # type: ignore[no-untyped-def]
    place, weight, nearest, share, rows, far, mixed, site, mix, merged, alone, start, ti, tj, value, out
):
    """LANES points at a time, one beside the other in memory, so that every step is one of vectors. Every point has as
    many steps as it needs: a group of entities each, from far to near."""
    n = out.shape[2]
    # Coefficient k of colour c begins at STEP (3 k + c).
    light, new = np.zeros(3 * n * STEP, np.float32), np.zeros(3 * n * STEP, np.float32)
    row, passes = np.empty(4 * n, np.float32), np.zeros(n * STEP, np.float32)
    left = np.empty(LANES, np.int64)  # the furthest entity that is still to come
    one, even, zero = np.float32(1.0), np.float32(EVEN), np.float32(0.0)
    for first in range(0, len(place), LANES):
        lanes = min(LANES, len(place) - first)
        for lane in range(lanes):
            at = first + lane
            left[lane] = nearest.shape[1] - 1
            if mixed:
                row[:] = zero
                for s in range(site.shape[1]):
                    w, own = mix[at, s], far[site[at, s]]
                    for c in range(3):
                        for k in range(n):
                            row[c * n + k] += w * own[c, k]
                for c in range(3):
                    for k in range(n):
                        light[(3 * k + c) * STEP + lane] = row[c * n + k]
            else:
                own = far[0] if len(far) == 1 else far[at]
                for c in range(3):
                    for k in range(n):
                        light[(3 * k + c) * STEP + lane] = own[c, k]
        going = lanes
        while going > 0:
            going = 0
            for lane in range(lanes):
                if left[lane] < -1:  # done: its light has been written
                    continue
                at = first + lane
                row[:] = zero
                rest, hidden, taken, single = one, zero, False, False
                while left[lane] >= 0:
                    e = nearest[at, left[lane]]
                    if e >= 0:
                        part = share[0, e] if len(share) == 1 else share[at, e]
                        w, p = weight[at, e], place[at, e]
                        total, own_hidden = zero, zero
                        for s in range(8):
                            total += w[s]
                        if total > zero:
                            if merged > 0.0:
                                for s in range(8):
                                    own_hidden += w[s] * part * (one - rows[p[s], 0] * (one / even))
                            if taken and (single or alone[e] or merged <= 0.0 or hidden + own_hidden > merged):
                                break
                            taken, single = True, alone[e]
                            hidden += own_hidden
                            rest -= total * part
                            _add_samples(rows, p, w, part, row)
                    left[lane] -= 1
                if not taken:
                    for c in range(3):
                        for k in range(n):
                            out[at, c, k] = light[(3 * k + c) * STEP + lane]
                    left[lane] = -2
                    for k in range(n):
                        passes[k * STEP + lane] = zero
                    continue
                going += 1
                row[0] += rest * even
                for k in range(n):
                    passes[k * STEP + lane] = row[k]
                    for c in range(3):
                        new[(3 * k + c) * STEP + lane] = row[(c + 1) * n + k]
            if going == 0:
                break
            _add_products(passes, light, new, start, ti, tj, value)
            light, new = new, light


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_samples(rows, place, weight, part, row):  # type: ignore[no-untyped-def]
    """Adds weight times part of the eight samples to row; those without weight have any place."""
    a, b, c, d = rows[place[0]], rows[place[1]], rows[place[2]], rows[place[3]]
    e, f, g, h = rows[place[4]], rows[place[5]], rows[place[6]], rows[place[7]]
    wa, wb, wc, wd = weight[0] * part, weight[1] * part, weight[2] * part, weight[3] * part
    we, wf, wg, wh = weight[4] * part, weight[5] * part, weight[6] * part, weight[7] * part
    for k in range(len(row)):
        near = wa * a[k] + wb * b[k] + wc * c[k] + wd * d[k]
        row[k] += near + (we * e[k] + wf * f[k] + wg * g[k] + wh * h[k])


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_products(passes, light, new, start, ti, tj, value):  # type: ignore[no-untyped-def]
    """Adds passes times light to new. Four pairs at a time, in slices: the compiler makes vectors of nothing else that
    was tried, and what is added to is read and written once in four times. A pair has one factor of the light, which is
    the longest."""
    colour = 3 * STEP
    for k in range(len(start) - 1):
        o = new[k * colour : (k + 1) * colour]
        for t in range(start[k], start[k + 1], 4):
            j0, j1, j2, j3 = tj[t], tj[t + 1], tj[t + 2], tj[t + 3]
            a, b = passes[ti[t, 0] : ti[t, 0] + LANES], passes[ti[t, 1] : ti[t, 1] + LANES]
            c, d = passes[ti[t + 1, 0] : ti[t + 1, 0] + LANES], passes[ti[t + 1, 1] : ti[t + 1, 1] + LANES]
            e, f = passes[ti[t + 2, 0] : ti[t + 2, 0] + LANES], passes[ti[t + 2, 1] : ti[t + 2, 1] + LANES]
            u, v = passes[ti[t + 3, 0] : ti[t + 3, 0] + LANES], passes[ti[t + 3, 1] : ti[t + 3, 1] + LANES]
            va, vb, vc, vd = value[t, 0], value[t, 1], value[t + 1, 0], value[t + 1, 1]
            ve, vf, vu, vv = value[t + 2, 0], value[t + 2, 1], value[t + 3, 0], value[t + 3, 1]
            x, y, z, w = (
                light[j0 : j0 + colour],
                light[j1 : j1 + colour],
                light[j2 : j2 + colour],
                light[j3 : j3 + colour],
            )
            for lane in range(LANES):
                p, q = va * a[lane] + vb * b[lane], vc * c[lane] + vd * d[lane]
                r, s = ve * e[lane] + vf * f[lane], vu * u[lane] + vv * v[lane]
                g, h = STEP + lane, 2 * STEP + lane
                o[lane] += p * x[lane] + q * y[lane] + r * z[lane] + s * w[lane]
                o[g] += p * x[g] + q * y[g] + r * z[g] + s * w[g]
                o[h] += p * x[h] + q * y[h] + r * z[h] + s * w[h]

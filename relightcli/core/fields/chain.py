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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.fields.entities import Entity, Lookup, look_up
from relightcli.core.shade.gather import in_parts
from relightcli.core.sphere.triple_product import coefficients
from relightcli.core.sphere.window import window

EVEN = math.sqrt(4.0 * math.pi)  # coefficient of y_0 of the function 1
LANES = 64


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
) -> None:
    """Puts what the entities reflect of lights (m, 3, N), in the world's frame, at each one's proxies into the rows:
    once for every sample, however many points read it. [Pan 2007, Eq. 11]"""
    order = math.isqrt(rows.shape[2])

    def put(e: int) -> None:
        transfer, part = entities[e].own.transfer, lookup.part(e)
        if transfer is None:
            return
        turn = entities[e].turn(order)
        seen = transfer.reflect(lights[e] @ turn.astype(np.float32), lookup.sample[part])
        back = (turn * window(order, windowed)).T.astype(np.float32, order="C")
        rows[part, 1:] = _times(seen.reshape(-1, order * order), back).reshape(seen.shape)

    in_parts(lambda a, b: _each(put, a, b), len(entities), threads)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _times(values, matrix):  # type: ignore[no-untyped-def]
    """values (k, N) times matrix (N, N): a library's threads would stand in the way of ours."""
    out = np.zeros(values.shape, np.float32)
    for r in range(values.shape[0]):
        for i in range(values.shape[1]):
            for j in range(values.shape[1]):
                out[r, j] += values[r, i] * matrix[i, j]
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
    lookup: Lookup, rows: NDArray[np.float32], far: NDArray[np.floating], threads: int = 1
) -> NDArray[np.float32]:
    """L_q (n, 3, N) float32 in the world's frame; far (3, N), or (n, 3, N), is what comes from behind all entities."""
    count, n = len(lookup.place), rows.shape[2]
    behind = np.ascontiguousarray(far, np.float32).reshape(-1, 3, n)
    out = np.empty((count, 3, n), np.float32)
    table = coefficients(math.isqrt(n))
    # Unsigned: no place counts from the end, which costs a test.
    factors = table.i.astype(np.uint64), table.j.astype(np.uint64), table.value.astype(np.float32)
    terms = np.searchsorted(table.k, np.arange(n + 1))
    flat = rows.reshape(len(rows), 4 * n)

    def part(a: int, b: int) -> None:
        own = behind if len(behind) == 1 else behind[a:b]
        look = lookup.place[a:b], lookup.weight[a:b], lookup.nearest[a:b]
        _chain(*look, flat, own, terms, *factors, out[a:b])

    in_parts(part, count, threads if count > 32 * LANES else 1)  # a few points fill no lanes when they are split
    return out


def passing(lookup: Lookup, rows: NDArray[np.float32], threads: int = 1) -> NDArray[np.float32]:
    """What all entities together let pass of even light of radiance 1, (n, N) float32."""
    dark = rows.copy()
    dark[:, 1:] = 0.0
    even = np.zeros((3, rows.shape[2]))
    even[0, 0] = EVEN
    return light_at(lookup, dark, even, threads)[:, 0]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _chain(place, weight, nearest, rows, far, terms, ti, tj, value, out):  # type: ignore[no-untyped-def]
    """LANES points at a time, one beside the other in memory, so that every step is one of vectors."""
    n = out.shape[2]
    light, new = np.zeros((3, n, LANES), np.float32), np.empty((3, n, LANES), np.float32)
    row, seen = np.empty(4 * n, np.float32), np.zeros((4 * n, LANES), np.float32)
    total = np.empty((3, LANES), np.float32)
    one, even = np.float32(1.0), np.float32(EVEN)
    for first in range(0, len(place), LANES):
        lanes = min(LANES, len(place) - first)
        for lane in range(lanes):
            own = far[0] if len(far) == 1 else far[first + lane]
            for c in range(3):
                for k in range(n):
                    light[c, k, lane] = own[c, k]
        for rank in range(nearest.shape[1] - 1, -1, -1):
            for lane in range(lanes):
                at = first + lane
                e = nearest[at, rank]
                row[:] = 0.0
                rest = one
                if e >= 0:
                    for s in range(8):
                        w = weight[at, e, s]
                        if w > 0.0:
                            rest -= w
                            sample = np.uint64(place[at, e, s])
                            for k in range(4 * n):
                                row[k] += w * rows[sample, k]
                row[0] += rest * even
                for k in range(4 * n):
                    seen[k, lane] = row[k]
            for k in range(n):
                total[:] = 0.0
                for t in range(terms[k], terms[k + 1]):
                    i, j, v = ti[t], tj[t], value[t]
                    for lane in range(LANES):
                        p = v * seen[i, lane]
                        total[0, lane] += p * light[0, j, lane]
                        total[1, lane] += p * light[1, j, lane]
                        total[2, lane] += p * light[2, j, lane]
                for c in range(3):
                    for lane in range(LANES):
                        new[c, k, lane] = seen[(c + 1) * n + k, lane] + total[c, lane]
            light, new = new, light
        for lane in range(lanes):
            for c in range(3):
                for k in range(n):
                    out[first + lane, c, k] = light[c, k, lane]

"""Self transfer: what an object's points receive of the light at its proxies, after its own shadows and reflections.

    T_p,k = w_k(p) (1 - sum over blocked directions of w y y') + sum over hits of w y(direction) e_x,k(-direction)

[Pan 2007, Eqs. 4 and 8], e_x,k the exit radiance of the point x that is hit (see `body`), itself linear in T_x,k: a
fixed point, iterated from the first term. Equation 8 is printed with the letters of another section.

Directions below the point's horizon count as open and unhit. The cosine cuts them off later; were they cut off here,
light of few bands would lose what is next to the horizon (0.8 % of the irradiance of a point that nothing shades).
What lies above the horizon is traced through 128 rays a pass, until the spread of the passes says that the blocked
light of every point is known to `tolerance` of even light.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.sampling import about
from relightcli.core.fields.body import Body, axes, diffuse_operator, local_rotations
from relightcli.core.fields.proxies import proxy_weights
from relightcli.core.fields.sampling import Found, blocked, gather, trace
from relightcli.core.sphere import sh
from relightcli.core.transport.sampling import point, stream_key
from relightcli.core.transport.tracer import Tracer
from relightcli.errors import NumericalError

RAYS_PER_PASS = 128
LEAST_PASSES, MOST_PASSES = 4, 32
CONVERGED = 1e-6  # of the largest exit radiance
MOST_ROUNDS = 400
_BLOCK = 1 << 16  # rays traced together


class Solution(NamedTuple):
    """transfer (P, m, N, N, C) float32, coefficient i then j (`field.SelfTransfer`); exits (P, terms, m N C) float32,
    e_b per light (k, j, colour)

    by_order (P, N, 1 + 2 C) float64: diffuse exit radiance of points of albedo 1 per light about the object, A_l y_i(n)
    / pi times their self transfer: without own reflections, the same in all colours, then what one of them adds, then
    what all others add
    rays; noise: largest standard error of a point's blocked light, relative to even light; rounds of the fixed point.
    """

    transfer: NDArray[np.float32]
    exits: NDArray[np.float32]
    by_order: NDArray[np.float64]
    rays: int
    noise: float
    rounds: int


def solve(tracer: Tracer, body: Body, proxies: NDArray[np.float64], tolerance: float = 0.01, seed: int = 0) -> Solution:
    """The self transfer of a body; tracer over its mesh alone. Raises NumericalError if the fixed point diverges."""
    found, harmonics, hidden, rays, noise = _look_around(tracer, body, tolerance, seed)
    n, lights = body.order**2, len(proxies) * body.order**2 * body.colours
    weights = proxy_weights(body.point, proxies, body.radius)
    frames = axes(body.normal)
    operator = diffuse_operator(body)
    turn = local_rotations(body.normal, body.order) if body.terms > 1 else np.zeros((0, n, n))
    shape = len(weights), n, len(proxies), n, body.colours
    open_ = ((np.eye(n) - hidden)[:, :, None, :] * weights[:, None, :, None])[..., None]
    first = np.ascontiguousarray(np.broadcast_to(open_, shape), np.float32).reshape(len(weights), n, lights)
    received = first
    exits = _exit(body, operator, turn, received)
    opened = np.einsum("pi,pij->pj", operator, np.eye(n) - hidden)
    once = np.zeros((len(weights), n, body.colours))
    rounds = 0
    if (found.point[:, 0] >= 0).any():
        change = largest = float(np.abs(exits).max())
        while change > CONVERGED * largest:
            rounds += 1
            received = first + gather(found, harmonics, exits, body, frames)
            if rounds == 1:
                once = _diffuse_part(operator, (received - first).reshape(shape))
            now = _exit(body, operator, turn, received)
            change, largest = float(np.abs(now - exits).max()), float(np.abs(now).max())
            exits = now
            if rounds > MOST_ROUNDS or not math.isfinite(change):
                raise NumericalError(
                    f"self transfer: after {rounds} reflections light still changes by {change:.3g} of {largest:.3g}"
                )
    transfer = np.ascontiguousarray(received.reshape(shape).transpose(0, 2, 1, 3, 4))
    rest = _diffuse_part(operator, (received - first).reshape(shape)) - once
    by_order = np.concatenate([opened[..., None], once, rest], axis=2)
    return Solution(transfer, exits, by_order, rays, noise, rounds)


def _diffuse_part(operator: NDArray[np.float64], received: NDArray[np.float32]) -> NDArray[np.float64]:
    """Diffuse exit radiance (P, N, C) of points of albedo 1 per light about the object: of what they receive, (P, N, m,
    N, C), the sum over the proxies."""
    out: NDArray[np.float64] = np.einsum("pi,pijc->pjc", operator, received.sum(axis=2, dtype=np.float64))
    return out


def exits_of(body: Body, transfer: NDArray[np.float32]) -> NDArray[np.float32]:
    """`Solution.exits` of its `transfer`."""
    received = transfer.transpose(0, 2, 1, 3, 4).reshape(len(transfer), body.order**2, -1)
    turn = local_rotations(body.normal, body.order) if body.terms > 1 else np.zeros((0, 1, 1))
    return _exit(body, diffuse_operator(body), turn, np.ascontiguousarray(received))


def _exit(
    body: Body, operator: NDArray[np.float64], turn: NDArray[np.float64], received: NDArray[np.float32]
) -> NDArray[np.float32]:
    """e_b (P, terms, K) of what points receive (P, N, K)."""
    out = np.empty((len(received), body.terms, received.shape[2]), np.float32)
    colours = body.colours
    albedo = np.ascontiguousarray(body.albedo[:, :colours])
    specular = np.ascontiguousarray(body.specular[:colours])
    _fill_exit(operator, turn, received, albedo, specular, out)
    return out


@njit(cache=True)
def _fill_exit(operator: Any, turn: Any, received: Any, albedo: Any, specular: Any, out: Any) -> None:
    colours = albedo.shape[1]
    sums = np.empty(out.shape[2])
    for p in range(len(out)):
        for b in range(out.shape[1]):
            sums[:] = 0.0
            for i in range(received.shape[1]):
                f = operator[p, i] if b == 0 else turn[p, b - 1, i]
                for k in range(len(sums)):
                    sums[k] += f * received[p, i, k]
            for k in range(len(sums)):
                c = k % colours
                out[p, b, k] = sums[k] * (albedo[p, c] if b == 0 else specular[c])


def _look_around(
    tracer: Tracer, body: Body, tolerance: float, seed: int
) -> tuple[Found, NDArray[np.float32], NDArray[np.float64], int, float]:
    """The hits of all points above their horizons, their harmonics (H, N), what they hide as matrices (P, N, N), the
    number of rays, and the largest standard error."""
    count, n = len(body.point), body.order**2
    origins = tracer.offset(body.point, body.normal)
    passes = np.zeros(count, np.int64)
    sums, squares = np.zeros((count, n)), np.zeros((count, n))
    error = np.zeros(count)
    active = np.arange(count)
    pieces: list[tuple[NDArray[np.int64], Found]] = []
    for number in range(MOST_PASSES):
        for a in range(0, len(active), _BLOCK // RAYS_PER_PASS):
            rows = active[a : a + _BLOCK // RAYS_PER_PASS]
            directions = np.empty((len(rows), RAYS_PER_PASS, 3), np.float32)
            _hemispheres(body.normal, rows, seed, number, directions)
            weight = np.full(len(rows), 2.0 * math.pi / RAYS_PER_PASS)
            found = trace(tracer, body, origins[rows], directions, weight)
            seen = blocked(found, sh.harmonics(found.direction.astype(np.float64), body.order).astype(np.float32))
            sums[rows] += seen
            squares[rows] += seen * seen
            pieces.append((np.repeat(rows, np.diff(found.start)), found))
        passes[active] += 1
        if number + 1 < LEAST_PASSES:
            continue
        k = number + 1
        variance = np.maximum(squares[active] - sums[active] ** 2 / k, 0.0).sum(axis=1) / (k * (k - 1.0))
        error[active] = np.sqrt(variance / (4.0 * math.pi))
        active = active[error[active] > tolerance]
        if not len(active):
            break
    owner = np.concatenate([rows for rows, _ in pieces])
    order = np.argsort(owner, kind="stable")
    start = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(owner, minlength=count), out=start[1:])
    joined = Found(
        start,
        np.concatenate([f.direction for _, f in pieces])[order],
        np.concatenate([f.point for _, f in pieces])[order],
        np.concatenate([f.share for _, f in pieces])[order],
        2.0 * math.pi / (RAYS_PER_PASS * passes.astype(np.float64)),
        np.zeros(count, np.int64),
    )
    harmonics = sh.harmonics(joined.direction.astype(np.float64), body.order).astype(np.float32)
    hidden = np.zeros((count, n, n))
    _hide(joined.start, harmonics, joined.weight, hidden)
    return joined, harmonics, hidden, int(passes.sum()) * RAYS_PER_PASS, float(error.max())


@njit(cache=True)
def _hemispheres(normals: Any, rows: Any, seed: int, number: int, out: Any) -> None:
    """Directions spread evenly over the hemisphere above every row's normal."""
    for i in range(len(rows)):
        p = rows[i]
        n = (np.float64(normals[p, 0]), np.float64(normals[p, 1]), np.float64(normals[p, 2]))
        key = stream_key(seed, p, number)
        for k in range(out.shape[1]):
            z, turn = point(key, k, 0)
            r, phi = math.sqrt(1.0 - z * z), 2.0 * math.pi * turn
            d = about(n, r * math.cos(phi), r * math.sin(phi), z)
            for c in range(3):
                out[i, k, c] = d[c]


@njit(cache=True)
def _hide(start: Any, harmonics: Any, weight: Any, out: Any) -> None:
    n = out.shape[1]
    for p in range(len(out)):
        for r in range(start[p], start[p + 1]):
            for i in range(n):
                f = weight[p] * np.float64(harmonics[r, i])
                for j in range(n):
                    out[p, i, j] += f * harmonics[r, j]

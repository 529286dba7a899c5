"""Transfer tensors: interreflections per light, material region and BRDF function. [Sun 2007, sec. 3.3]

    T1_x(q, s, l) = int y_s(w) [exit radiance of y(x, w) in channel q, light l]                           one bounce
    T2_x(q2, s, l, q1) = the same, with T1 of the receivers as their light                                two bounces

A channel q is a part of a surface's exit radiance whose factor may change: the diffuse term or one basis function of an
adjustable material, or one colour of all fixed surfaces. The integral is a sum over the blocked cells of the receiver x
and what stands behind them (`shade.gather`); s counts spherical harmonics in world space, or is the mean over the
hemisphere weighted by the cosine. A surface sends what its light factors have gathered, per light, weighted by the view
factors towards x (`brdf.transport_basis`): no BRDF is evaluated per pair of directions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.separable import POLAR, ROWS, TERMS
from relightcli.core.parts import in_parts
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.lobe_factors import FAST, axes_of, waves
from relightcli.core.sphere import cube, sh

RIDGE = 1e-3  # of `light_fit`: below a tenth it changes little
DIFFUSE, THROUGH, SPECULAR = 0, 1, 2  # parts of a surface: reflected, let through from the other side, specular + p
ORDERS = np.array([m for row in ROWS for m in range(row)])  # azimuthal order of the light factors


class Exits(NamedTuple):
    """What each material sends into which channels: entries of material m are start[m] to start[m + 1].

    channel (E,) int32; part (E,) int32: DIFFUSE, THROUGH or SPECULAR + p, p counting the view factors of the material;
    weight (E,) float32; tint (E,) int32, the colour whose texture value multiplies it, or -1; view_factor (M, P, POLAR,
    TERMS) float32, zero beyond the material's own. `functions` (M,) int32: how many it has.
    """

    start: NDArray[np.int32]
    channel: NDArray[np.int32]
    part: NDArray[np.int32]
    weight: NDArray[np.float32]
    tint: NDArray[np.int32]
    functions: NDArray[np.int32]
    view_factor: NDArray[np.float32]


class Sources(NamedTuple):
    """What receivers have gathered, per light l.

    even (N, L) float32, irradiance over pi; factor (G, F, L) float32, per used light factor, of the receivers with a
    lobe, at row (N,), -1 for the others; used (F, 2) int64, whether cosine (0) or sine (1), and the term; partner (N,)
    int64, the receiver on the other side."""

    even: NDArray[np.float32]
    factor: NDArray[np.float32]
    row: NDArray[np.int32]
    used: NDArray[np.int64]
    partner: NDArray[np.int64]


def used_terms(highest: int) -> NDArray[np.int64]:
    """The pairs (0 cosine or 1 sine, term) of the light factors with an order up to `highest`, (F, 2)."""
    pairs = [(0, k) for k in range(TERMS) if ORDERS[k] <= highest]
    pairs += [(1, k) for k in range(TERMS) if 0 < ORDERS[k] <= highest]
    return np.array(pairs, np.int64)


def sky_sources(
    bits: NDArray[np.uint8],
    normals: NDArray[np.float32],
    model: NDArray[np.int32],
    light_factor: NDArray[np.float32],
    face: int,
    cells: int,
    used: NDArray[np.int64],
    threads: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Response of receivers to unit radiance from each cell of a face of the sky's 6 x C x C: even (N, C C), and factor
    (n, F, C C) of those with a model (N,) >= 0, in their order; it is the place in light_factor (models, POLAR, TERMS).

    bits (N, 6, R, R/8). The cosine is integrated over the visible texels; the light factors are taken in the middle of
    quarter cells, times the visible solid angle there.
    """
    resolution = bits.shape[2]
    fine = 2 * cells if resolution % (2 * cells) == 0 else cells
    directions = cube.texel_directions(resolution)[face].reshape(-1, 3)
    solid = cube.solid_angles(resolution).reshape(-1, 1)
    moment = np.concatenate([directions * solid, solid], axis=1).astype(np.float32)
    middle = cube.texel_directions(fine)[face].reshape(-1, 3)
    words = np.ascontiguousarray(bits[:, face]).reshape(len(bits), -1)
    row = np.cumsum(model >= 0) - 1
    even = np.zeros((len(bits), cells * cells), np.float32)
    factor = np.zeros((int((model >= 0).sum()), len(used), cells * cells), np.float32)

    def part(a: int, b: int) -> None:
        _sky_sources(
            words[a:b], normals[a:b], model[a:b], row[a:b], light_factor, moment, middle, resolution, fine, cells,
            used, even[a:b], factor,
        )  # fmt: skip

    in_parts(part, len(bits), threads)
    return even, factor


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _sky_sources(  # type: ignore[no-untyped-def]
    words, normals, model, row, light_factor, moment, middle, resolution, fine, cells, used, even, factor
):
    side, ratio = resolution // fine, fine // cells
    wave = np.empty((2, TERMS), np.float32)
    scale = np.float32(1.0 / math.pi)
    for i in range(len(words)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        axes = axes_of((np.float64(nx), np.float64(ny), np.float64(nz)))
        m = model[i]
        for c in range(fine * fine):
            r, column = c // fine, c % fine
            e = s = np.float32(0.0)
            for a in range(side):
                first = (r * side + a) * resolution + column * side
                for t in range(first, first + side):
                    if (words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1):
                        e += nx * moment[t, 0] + ny * moment[t, 1] + nz * moment[t, 2]
                        s += moment[t, 3]
            if s == np.float32(0.0):
                continue
            light = (r // ratio) * cells + column // ratio
            even[i, light] += scale * max(e, np.float32(0.0))
            if m < 0:
                continue
            d = (middle[c, 0], middle[c, 1], middle[c, 2])
            if waves(light_factor[m], axes, d, wave):
                for f in range(len(used)):
                    factor[row[i], f, light] += s * wave[used[f, 0], used[f, 1]]


def gather_transfer(
    gather: Gather,
    first: int,
    sources: Sources,
    exits: Exits,
    channels: int,
    order: int,
    normals: NDArray[np.float32],
    material: NDArray[np.int32],
    texture: NDArray[np.float32] | None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Transfer (n, Q, S, L) float32 of the receivers whose entries `gather` holds; the first of them is `first`.

    S = order^2 world-space spherical harmonics, or with order 0 the mean over the hemisphere, weighted by the cosine.
    normals (N, 3), material (N,), texture (N, 3) or None belong to all receivers.
    """
    directions = cube.texel_directions(gather.cells).reshape(-1, 3)
    basis = sh.harmonics(directions, order).astype(np.float32) if order else np.zeros((len(directions), 1), np.float32)
    n = len(gather.start) - 1
    out = np.zeros((n, channels, basis.shape[1], sources.even.shape[1]), np.float32)
    tint = np.ones((1, 3), np.float32) if texture is None else texture

    def part(a: int, b: int) -> None:
        _gather_transfer(a, b, gather, sources, exits, directions, basis, order, normals, material, tint, out)

    in_parts(part, n, threads)
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def _gather_transfer(  # type: ignore[no-untyped-def]
    first, last, gather, sources, exits, directions, basis, order, normals, material, tint, out
):
    lights = sources.even.shape[1]
    functions = exits.view_factor.shape[1]
    wave = np.empty((2, TERMS), np.float32)
    sent = np.empty((SPECULAR + functions, lights), np.float32)
    textured = len(tint) > 1
    for i in range(first, last):
        for z in range(gather.start[i], gather.start[i + 1]):
            y, c = gather.source[z], gather.cell[z]
            m = material[y]
            if exits.start[m] == exits.start[m + 1]:
                continue
            count = exits.functions[m] if sources.row[y] >= 0 else 0
            if count:
                axes = axes_of((np.float64(normals[y, 0]), np.float64(normals[y, 1]), np.float64(normals[y, 2])))
                back = (-directions[c, 0], -directions[c, 1], -directions[c, 2])
                for p in range(count):
                    line = sent[SPECULAR + p]
                    line[:] = np.float32(0.0)
                    if waves(exits.view_factor[m, p], axes, back, wave):
                        for f in range(len(sources.used)):
                            w = wave[sources.used[f, 0], sources.used[f, 1]]
                            gathered = sources.factor[sources.row[y], f]
                            for l in range(lights):  # noqa: E741
                                line[l] += w * gathered[l]
            for e in range(exits.start[m], exits.start[m + 1]):
                part = exits.part[e]
                weight = exits.weight[e]
                if textured and exits.tint[e] >= 0:
                    weight *= tint[y, exits.tint[e]]
                if part == DIFFUSE:
                    line = sources.even[y]
                elif part == THROUGH:
                    line = sources.even[sources.partner[y]]
                else:
                    if part - SPECULAR >= count:
                        continue
                    line = sent[part]
                q = exits.channel[e]
                if order == 0:
                    w = weight * gather.cosine[z] * np.float32(1.0 / math.pi)
                    for l in range(lights):  # noqa: E741
                        out[i, q, 0, l] += w * line[l]
                    continue
                weight *= gather.solid_angle[z]
                for s in range(basis.shape[1]):
                    w = weight * basis[c, s]
                    target = out[i, q, s]
                    for l in range(lights):  # noqa: E741
                        target[l] += w * line[l]


def light_factor_projections(light_factor: NDArray[np.float32], order: int) -> NDArray[np.float64]:
    """Integrals of every light factor times spherical harmonics in the local frame: (TERMS, 2, order^2), cosine and
    sine; light_factor (POLAR, TERMS)."""
    p = (np.arange(POLAR) + 0.5) / POLAR
    cosine = 1.0 - p * p
    sine = np.sqrt(1.0 - cosine * cosine)
    values = sh.harmonics(np.stack([sine, np.zeros(POLAR), cosine], -1), order)  # at azimuth 0: those with m >= 0
    measure = 2.0 * p / POLAR  # sin(theta) dtheta
    out = np.zeros((TERMS, 2, order * order))
    for k, m in enumerate(ORDERS):
        for band in range(m, order):
            integral = float((light_factor[:, k] * values[:, band * (band + 1) + m] * measure).sum())
            azimuth = 2.0 * math.pi if m == 0 else math.pi
            out[k, 0, band * (band + 1) + m] = azimuth * integral
            if m:
                out[k, 1, band * (band + 1) - m] = azimuth * integral
    return out


def light_fit(even: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What turns a sky's direct light into lights that bounce alike: fit (L, S), keep (L, L) float32.

    The lights are few and broad; the mean radiance of a sky over each, c0 (L,), has a low sun shine from all of a cell.
    Instead they are matched by what they do first, at S receivers: c = c0 + F (E - M c0), with M = `even` (S, L) the
    irradiance over pi under each light, E (S,) that under the sky, and F = (M'M + RIDGE trace(M'M) / L)^-1 M' the
    least squares solution near c0. As c = F E + (1 - F M) c0: fit = F, keep = 1 - F M.
    """
    m = np.asarray(even, np.float64)
    gram = m.T @ m
    count = len(gram)
    ridge = max(RIDGE * float(np.trace(gram)) / count, 1e-30)
    fit = np.linalg.solve(gram + ridge * np.eye(count), m.T)
    return fit.astype(np.float32), (np.eye(count) - fit @ m).astype(np.float32)


def even_projection(order: int) -> NDArray[np.float64]:
    """Integral of (cos theta)+ / pi times local spherical harmonics, (order^2,): what `Sources.even` takes."""
    x, w = np.polynomial.legendre.leggauss(64)
    z = 0.5 * (x + 1.0)
    values = sh.harmonics(np.stack([np.sqrt(1.0 - z * z), np.zeros(64), z], -1), order)
    out = np.zeros(order * order)
    for band in range(order):
        out[band * (band + 1)] = float((w * z * values[:, band * (band + 1)]).sum())  # 2 pi / pi * 1/2
    return out


def local_rotations(normals: NDArray[np.float32], order: int) -> NDArray[np.float32]:
    """R (N, S, S) float32 from world-space coefficients to those in the receivers' frames (`axes_of`), S = order^2.

    a_local = R a_world: y_j(F' w) integrated against y_s(w) by a product rule that is exact for 2 (order - 1) bands.
    """
    x, w = np.polynomial.legendre.leggauss(order)
    turns = 2 * order
    phi = 2.0 * math.pi * np.arange(turns) / turns
    z, f = np.meshgrid(x, phi, indexing="ij")
    r = np.sqrt(1.0 - z * z)
    world = np.stack([r * np.cos(f), r * np.sin(f), z], -1).reshape(-1, 3)
    weight = np.repeat(w, turns) * (2.0 * math.pi / turns)
    weighted = sh.harmonics(world, order) * weight[:, None]
    out = np.empty((len(normals), order * order, order * order), np.float32)
    frames = np.empty((len(normals), 3, 3))
    _frames(normals, frames)
    step = 8192
    for a in range(0, len(normals), step):
        local = np.einsum("nij,qj->nqi", frames[a : a + step], world)
        local /= np.linalg.norm(local, axis=2, keepdims=True)
        out[a : a + step] = np.einsum("nqj,qs->njs", sh.harmonics(local, order), weighted, optimize=True)
    return out


@njit(cache=True)
def _frames(normals, out):  # type: ignore[no-untyped-def]
    for i in range(len(normals)):
        axes = axes_of((np.float64(normals[i, 0]), np.float64(normals[i, 1]), np.float64(normals[i, 2])))
        for k in range(3):
            for x in range(3):
                out[i, k, x] = axes[k][x]

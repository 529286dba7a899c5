"""Specular lobes towards any view by a few directions, each with the visible share and the light of its surroundings.

    B = A / (sum of w) x sum over j of w_j V_j L_j,   w_j = s(l_j, v) / (N q(l_j)),   A the directional albedo

l_j are directions in equal parts of the lobe, whose density is q: the same half-vectors for all receivers, turned with
the view. L_j is the mean radiance over about the solid angle 1 / (N q) that a direction stands for, by skies that are
prefiltered with Gaussians [Sun 2007, sec. 4.1]; V_j is the visible share of about as much, by means of the bits over
squares of texels. So light and shadow are told apart within a lobe, and even light gives the albedo where nothing
blocks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.albedo import directional_albedo
from relightcli.core.lights.environment import SkyCube
from relightcli.core.lights.prefiltered import place_on_cube, prefiltered_sky
from relightcli.core.parts import in_parts
from relightcli.core.shade.lobe_factors import axes_of

FEWEST, MOST, RISE = 16, 28, 40.0  # directions: more by RISE times the roughness
DEGREES = (0.0, 4.5, 8.0, 15.0, 27.0, 48.0)  # of the skies: three standard deviations; 0 is a texel
SIDES = (4, 8, 16)  # of the squares of texels whose means are kept; each of four of the one before
POLAR = 64  # samples of the albedo over cos(theta_o), from 0 to 1
# Standard deviation of a sky over the radius of the disc of a direction's solid angle. That of the disc itself is 0.5;
# wider ones overlap, so that what a small light gives does not hang on where it lies between the directions.
SPREAD = 0.7
STEPS = 16  # of v.h, over which the solid angle of a direction changes
_FAST = {"reassoc", "contract", "nsz"}


class Skies(NamedTuple):
    """Prefiltered skies one after another: value (T, 4) float32, as of `prefiltered_sky`; first (L,) int64, where each
    begins; nodes (L,) int64, less one, along a face; most (L - 1,): the solid angle up to which each but the last is
    taken."""

    value: NDArray[np.float32]
    first: NDArray[np.int64]
    nodes: NDArray[np.int64]
    most: NDArray[np.float64]


class Shares(NamedTuple):
    """Visible shares of n receivers: words (n, 6 R R / 8) uint8, their bits; mean (n, P) uint8, shares of squares times
    255; first (Q,) int64, where those of each size begin; squares (Q,) int64, those along a face; most (Q,): the solid
    angle from which each size is taken, below the first the bits."""

    words: NDArray[np.uint8]
    resolution: int
    mean: NDArray[np.uint8]
    first: NDArray[np.int64]
    squares: NDArray[np.int64]
    most: NDArray[np.float64]


class Lobe(NamedTuple):
    """One lobe for specular colour 1. half (N, 3) float32: half-vectors about the normal, the view's azimuth being 0;
    size (N,) float32: solid angle of each direction over v.h; albedo (POLAR,) float32; fresnel: f0, or -1 for
    Blinn-Phong, which has none."""

    half: NDArray[np.float32]
    size: NDArray[np.float32]
    albedo: NDArray[np.float32]
    fresnel: float


def like_roughness(family: str, values: tuple[float, ...]) -> float:
    """Roughness of (f0, roughness); for (shininess,) that of a Cook-Torrance lobe which is about as wide."""
    return math.sqrt(2.0 / (values[0] + 2.0)) if family == "blinn-phong" else values[1]


def make_lobe(family: str, *values: float, count: int | None = None) -> Lobe:
    """make_lobe("cook-torrance", f0, roughness) or make_lobe("blinn-phong", shininess). count: of directions."""
    count = count or min(round(FEWEST + RISE * like_roughness(family, values)), MOST)
    u = (np.arange(count) + 0.5) / count
    turn = 2.0 * math.pi * np.mod(0.5 + 0.6180339887498949 * np.arange(count), 1.0)
    if family == "blinn-phong":
        (exponent,) = values
        log_cosine = np.log1p(-u) / (exponent + 1.0)
        density = (exponent + 1.0) / (2.0 * math.pi) * np.exp(exponent * log_cosine)
        fresnel = -1.0
    else:
        fresnel, roughness = values
        tan2 = -(roughness**2) * np.log1p(-u)
        log_cosine = -0.5 * np.log1p(tan2)
        density = (1.0 - u) / (math.pi * roughness**2) * np.exp(-3.0 * log_cosine)
    sine = np.sqrt(-np.expm1(2.0 * log_cosine))
    half = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.exp(log_cosine)], axis=1)
    albedo = directional_albedo(family, np.array([values]), np.linspace(0.0, 1.0, POLAR))[0]
    return Lobe(
        half.astype(np.float32), (4.0 / (count * density)).astype(np.float32), albedo.astype(np.float32), fresnel
    )


def make_skies(sky: SkyCube, threads: int = 1) -> Skies:
    """Of a sky after `environment.splat`."""
    found = prefiltered_sky(sky, DEGREES, threads=threads)
    nodes = np.array([level.shape[1] - 1 for level in found])
    first = np.concatenate([[0], np.cumsum(6 * (nodes + 1) ** 2)[:-1]])
    sigma = np.radians(np.array(DEGREES)) / 3.0
    sigma[0] = math.sqrt(4.0 * math.pi / 6.0) / sky.resolution / math.sqrt(12.0)
    most = math.pi * sigma[:-1] * sigma[1:] / SPREAD**2
    return Skies(np.concatenate([level.reshape(-1, 4) for level in found]), first, nodes, most)


def make_shares(bits: NDArray[np.uint8], threads: int = 1) -> Shares:
    """bits (n, 6, R, R/8). Squares are those that go into a face twice at least."""
    resolution = bits.shape[2]
    words = np.ascontiguousarray(bits).reshape(len(bits), -1)
    sides = [side for side in SIDES if 2 * side <= resolution and resolution % side == 0]
    count = np.array([resolution // side for side in sides], np.int64)
    first = np.concatenate([[0], np.cumsum(6 * count**2)]).astype(np.int64)
    mean = np.zeros((len(bits), first[-1]), np.uint8)
    in_parts(lambda a, b: _means(words[a:b], resolution, count, first, mean[a:b]), len(bits), threads)
    areas = 4.0 * math.pi / (6.0 * resolution**2) * np.array([1.0, *[side * side for side in sides]])
    return Shares(words, resolution, mean, first[:-1], count, np.sqrt(areas[:-1] * areas[1:]))


def sample_lobes(
    shares: Shares,
    skies: Skies,
    views: NDArray[np.float32],
    normals: NDArray[np.float32],
    rows: NDArray[np.integer],
    lobe: Lobe,
    colour: NDArray[np.floating],
    out: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Adds to out[rows] (n, 3) the light of one material's lobe, times its specular colour (3,).

    views, normals (n, 3) float32 unit; rows (M,): receivers that have the material.
    """
    weight, fresnel = np.asarray(colour, np.float32), np.float32(lobe.fresnel)
    angle = lobe.size[:, None] * (np.arange(STEPS + 1) + 0.5) / STEPS
    levels = np.stack([np.searchsorted(shares.most, angle) - 1, np.searchsorted(skies.most, angle)], -1).astype(
        np.int64
    )

    def some(a: int, b: int) -> None:
        _sample(
            shares.words, shares.resolution, shares.mean, shares.first, shares.squares, skies.value, skies.first,
            skies.nodes, views, normals, rows[a:b], lobe.half, levels, lobe.albedo, fresnel, weight, out,
        )  # fmt: skip

    in_parts(some, len(rows), threads)


@njit(cache=True, nogil=True)
def _means(words, resolution, count, first, mean):  # type: ignore[no-untyped-def]
    ones = np.zeros(16, np.int64)
    for value in range(1, 16):
        ones[value] = ones[value >> 1] + (value & 1)
    finest, row = resolution // SIDES[0], resolution // 8  # bytes of a row
    seen = np.empty((6, finest, finest), np.int64)
    for i in range(len(words)):
        seen[:] = 0
        for line in range(6 * resolution):
            face, r = line // resolution, line % resolution // SIDES[0]
            for k in range(row):
                byte = words[i, line * row + k]
                seen[face, r, 2 * k] += ones[byte & 15]
                seen[face, r, 2 * k + 1] += ones[byte >> 4]
        n = finest
        for q in range(len(count)):
            if q:
                n //= 2
                for face in range(6):
                    for r in range(n):
                        for c in range(n):
                            upper = seen[face, 2 * r, 2 * c] + seen[face, 2 * r, 2 * c + 1]
                            lower = seen[face, 2 * r + 1, 2 * c] + seen[face, 2 * r + 1, 2 * c + 1]
                            seen[face, r, c] = upper + lower
            area = (resolution // n) ** 2
            for face in range(6):
                for r in range(n):
                    for c in range(n):
                        mean[i, first[q] + (face * n + r) * n + c] = (255 * seen[face, r, c] + area // 2) // area


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _open(words, i, t):  # type: ignore[no-untyped-def]
    return np.float32((words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _between_texels(words, i, resolution, face, u, v):  # type: ignore[no-untyped-def]
    """Visibility at a place of a face, bilinear between the texels' centres."""
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    top = np.float32(resolution) - np.float32(1.001)
    b = max(min((v + one) * half * np.float32(resolution) - half, top), zero)
    c = max(min((u + one) * half * np.float32(resolution) - half, top), zero)
    g, h = int(b), int(c)
    b, c = b - np.float32(g), c - np.float32(h)
    t = (face * resolution + g) * resolution + h
    low = (one - c) * _open(words, i, t) + c * _open(words, i, t + 1)
    t += resolution
    high = (one - c) * _open(words, i, t) + c * _open(words, i, t + 1)
    return low + b * (high - low)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _sample(  # type: ignore[no-untyped-def]
    words,
    resolution,
    mean,
    mean_first,
    mean_count,
    sky,
    sky_first,
    sky_nodes,
    views,
    normals,
    rows,
    half,
    levels,
    albedo,
    fresnel,
    colour,
    out,
):
    zero, one, two, middle = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
    inverse = one / half[:, 2]
    polar, steps = np.float32(len(albedo) - 1), np.float32(levels.shape[1] - 1)
    for i in rows:
        s, t, n = axes_of((normals[i, 0], normals[i, 1], normals[i, 2]))
        x = np.float32(s[0] * views[i, 0] + s[1] * views[i, 1] + s[2] * views[i, 2])
        y = np.float32(t[0] * views[i, 0] + t[1] * views[i, 1] + t[2] * views[i, 2])
        z = np.float32(n[0] * views[i, 0] + n[1] * views[i, 1] + n[2] * views[i, 2])
        if not z > zero:
            continue
        radius = np.float32(math.sqrt(x * x + y * y))
        # The view is at (radius, 0, z) in a frame with the axes p, q, n.
        cosine, sine = one, zero
        if radius > np.float32(1e-6):
            cosine, sine = x / radius, y / radius
        p0 = np.float32(cosine * s[0] + sine * t[0])
        p1 = np.float32(cosine * s[1] + sine * t[1])
        p2 = np.float32(cosine * s[2] + sine * t[2])
        q0 = np.float32(cosine * t[0] - sine * s[0])
        q1 = np.float32(cosine * t[1] - sine * s[1])
        q2 = np.float32(cosine * t[2] - sine * s[2])
        steep = one / z
        total = red = green = blue = zero
        for j in range(len(half)):
            hx, hy, hz = half[j, 0], half[j, 1], half[j, 2]
            vh = radius * hx + z * hz
            if not vh > zero:
                continue
            lz = two * vh * hz - z
            if not lz > zero:
                continue
            if fresnel < zero:
                weight = lz * vh
            else:
                f = one - min(vh, one)
                f = fresnel + (one - fresnel) * (f * f) * (f * f) * f
                # G (v.h) / ((n.v)(n.h)), with the divisions by n.v taken out
                weight = f * min(vh * steep * inverse[j], two * min(one, lz * steep))
            total += weight
            lx, ly = two * vh * hx - radius, two * vh * hy
            face, u, v = place_on_cube(
                lx * p0 + ly * q0 + lz * n[0], lx * p1 + ly * q1 + lz * n[1], lx * p2 + ly * q2 + lz * n[2]
            )
            step = int(min(vh, one) * steps)
            level = levels[j, step, 0]
            if level < 0:
                seen = weight * _between_texels(words, i, resolution, face, u, v)
            else:
                n_squares = mean_count[level]
                r = min(int((v + one) * middle * np.float32(n_squares)), n_squares - 1)
                c = min(int((u + one) * middle * np.float32(n_squares)), n_squares - 1)
                seen = weight * np.float32(mean[i, mean_first[level] + (face * n_squares + r) * n_squares + c])
                seen *= np.float32(1.0 / 255.0)
            if not seen > zero:
                continue
            level = levels[j, step, 1]
            nodes = sky_nodes[level]
            r = int((v + one) * middle * np.float32(nodes) + middle)
            c = int((u + one) * middle * np.float32(nodes) + middle)
            light = sky[sky_first[level] + (face * (nodes + 1) + r) * (nodes + 1) + c]
            red += seen * light[0]
            green += seen * light[1]
            blue += seen * light[2]
        if not total > zero:
            continue
        at = min(z, np.float32(0.99999)) * polar
        k = int(at)
        energy = (albedo[k] + (at - np.float32(k)) * (albedo[k + 1] - albedo[k])) / total
        out[i, 0] += colour[0] * energy * red
        out[i, 1] += colour[1] * energy * green
        out[i, 2] += colour[2] * energy * blue

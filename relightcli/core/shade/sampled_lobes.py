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

COUNT = 28  # directions
DEGREES = (0.0, 4.5, 8.0, 15.0, 27.0, 48.0)  # of the skies: three standard deviations; 0 is a texel
SIDES = (4, 8, 16)  # of the squares of texels whose means are kept
POLAR = 64  # samples of the albedo over cos(theta_o), from 0 to 1
_FAST = {"reassoc", "contract", "nsz"}


class Skies(NamedTuple):
    """Prefiltered skies one after another: value (T, 4) float32, as of `prefiltered_sky`; first (L,) int64, where each
    begins; nodes (L,) int64, less one, along a face; most (L,) float32: the solid angle up to which each is taken."""

    value: NDArray[np.float32]
    first: NDArray[np.int64]
    nodes: NDArray[np.int64]
    most: NDArray[np.float32]


class Shares(NamedTuple):
    """Visible shares of n receivers: words (n, 6 R R / 8) uint8, their bits; mean (n, P) uint8, shares of squares times
    255; first (Q,) int64, where those of each size begin; count (Q,) int64, squares along a face; most (Q,) float32:
    the solid angle up to which each size is taken, and before them the single texels, whose is `texel`."""

    words: NDArray[np.uint8]
    resolution: int
    mean: NDArray[np.uint8]
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    most: NDArray[np.float32]
    texel: float


class Lobe(NamedTuple):
    """One lobe for specular colour 1. half (N, 3) float32: half-vectors about the normal, the view's azimuth being 0;
    size (N,) float32: solid angle of each direction over v.h; albedo (POLAR,) float32; fresnel: f0, or -1 for
    Blinn-Phong, which has none."""

    half: NDArray[np.float32]
    size: NDArray[np.float32]
    albedo: NDArray[np.float32]
    fresnel: float


def make_lobe(family: str, *values: float, count: int = COUNT) -> Lobe:
    """make_lobe("cook-torrance", f0, roughness) or make_lobe("blinn-phong", shininess)."""
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
    # A disc has a quarter of its radius squared for the variance along an axis.
    between = np.sqrt(sigma[:-1] * sigma[1:])
    most = np.append(4.0 * math.pi * between**2, np.inf).astype(np.float32)
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
    texel = 4.0 * math.pi / (6.0 * resolution**2)
    # Bilinear look-up is about twice as wide as a square.
    areas = texel * np.array([1.0, *[side * side for side in sides]]) * 2.0
    most = np.append(np.sqrt(areas[:-1] * areas[1:]), np.inf)
    return Shares(words, resolution, mean, first[:-1], count, most[1:].astype(np.float32), float(most[0]))


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
    weight = np.asarray(colour, np.float32)
    fresnel = np.float32(lobe.fresnel)

    def some(a: int, b: int) -> None:
        _sample(
            *shares[:-1],
            np.float32(shares.texel),
            *skies,
            views,
            normals,
            rows[a:b],
            lobe.half,
            lobe.size,
            lobe.albedo,
            fresnel,
            weight,
            out,
        )

    in_parts(some, len(rows), threads)


@njit(cache=True, nogil=True)
def _means(words, resolution, count, first, mean):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        for q in range(len(count)):
            n = count[q]
            side = resolution // n
            for face in range(6):
                for r in range(n):
                    for c in range(n):
                        seen = 0
                        for y in range(r * side, (r + 1) * side):
                            for x in range(c * side, (c + 1) * side):
                                t = (face * resolution + y) * resolution + x
                                seen += (words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1)
                        mean[i, first[q] + (face * n + r) * n + c] = (255 * seen + side * side // 2) // (side * side)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _place(u, v, n):  # type: ignore[no-untyped-def]
    """Row and column of the first of 2 x 2 squares about a place of a face that has n along a side, and parts."""
    one, half, zero = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    top = np.float32(n) - np.float32(1.001)
    b = max(min((v + one) * half * np.float32(n) - half, top), zero)
    c = max(min((u + one) * half * np.float32(n) - half, top), zero)
    g, h = int(b), int(c)
    return g, h, b - np.float32(g), c - np.float32(h)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _open(words, i, t):  # type: ignore[no-untyped-def]
    return np.float32((words[i, t >> 3] >> np.uint8(t & 7)) & np.uint8(1))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _share(words, resolution, mean, first, count, most, texel, i, face, u, v, angle):  # type: ignore[no-untyped-def]
    one = np.float32(1.0)
    if len(count) == 0 or angle <= texel:
        g, h, b, c = _place(u, v, resolution)
        t = (face * resolution + g) * resolution + h
        low = (one - c) * _open(words, i, t) + c * _open(words, i, t + 1)
        t += resolution
        high = (one - c) * _open(words, i, t) + c * _open(words, i, t + 1)
        return low + b * (high - low)
    q = 0
    while q < len(count) - 1 and angle > most[q]:
        q += 1
    n = count[q]
    g, h, b, c = _place(u, v, n)
    t = first[q] + (face * n + g) * n + h
    low = (one - c) * np.float32(mean[i, t]) + c * np.float32(mean[i, t + 1])
    t += n
    high = (one - c) * np.float32(mean[i, t]) + c * np.float32(mean[i, t + 1])
    return (low + b * (high - low)) * np.float32(1.0 / 255.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _sample(  # type: ignore[no-untyped-def]
    words,
    resolution,
    mean,
    mean_first,
    mean_count,
    mean_most,
    texel,
    sky,
    sky_first,
    sky_nodes,
    sky_most,
    views,
    normals,
    rows,
    half,
    size,
    albedo,
    fresnel,
    colour,
    out,
):
    zero, one, two, middle = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
    polar = np.float32(len(albedo) - 1)
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
                weight = f * min(vh / (z * hz), two * min(one, lz / z))
            total += weight
            lx, ly = two * vh * hx - radius, two * vh * hy
            face, u, v = place_on_cube(
                lx * p0 + ly * q0 + lz * n[0], lx * p1 + ly * q1 + lz * n[1], lx * p2 + ly * q2 + lz * n[2]
            )
            angle = size[j] * vh
            seen = weight * _share(
                words, resolution, mean, mean_first, mean_count, mean_most, texel, i, face, u, v, angle
            )
            if not seen > zero:
                continue
            k = 0
            while angle > sky_most[k]:
                k += 1
            nodes = np.float32(sky_nodes[k])
            b = max(min((v + one) * middle * nodes, nodes - np.float32(1e-3)), zero)
            c = max(min((u + one) * middle * nodes, nodes - np.float32(1e-3)), zero)
            g, h = int(b), int(c)
            b, c = b - np.float32(g), c - np.float32(h)
            m = sky_first[k] + (face * (sky_nodes[k] + 1) + g) * (sky_nodes[k] + 1) + h
            e0, e1, e2, e3 = sky[m], sky[m + 1], sky[m + sky_nodes[k] + 1], sky[m + sky_nodes[k] + 2]
            w0, w1 = seen * (one - b) * (one - c), seen * (one - b) * c
            w2, w3 = seen * b * (one - c), seen * b * c
            red += w0 * e0[0] + w1 * e1[0] + w2 * e2[0] + w3 * e3[0]
            green += w0 * e0[1] + w1 * e1[1] + w2 * e2[1] + w3 * e3[1]
            blue += w0 * e0[2] + w1 * e1[2] + w2 * e2[2] + w3 * e3[2]
        if not total > zero:
            continue
        at = min(z, np.float32(0.99999)) * polar
        k = int(at)
        energy = (albedo[k] + (at - np.float32(k)) * (albedo[k + 1] - albedo[k])) / total
        out[i, 0] += colour[0] * energy * red
        out[i, 1] += colour[1] * energy * green
        out[i, 2] += colour[2] * energy * blue

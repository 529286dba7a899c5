"""Sampling of directions from the models of `models.py`, with the density that belongs to it.

A lobe is picked with a probability by its albedo, then a direction drawn from it:

    diffuse       cos/pi about n;   transmitted  cos/pi about -n
    half-vector   n.h from D (n.h) (cook-torrance) or (n.h)^a (blinn-phong), l the mirror of v in h
    phong         (r.l)^a about the mirrored view r

and the density is the mixture's,  p(l) = w_d (n.l)+/pi + w_s q(l) + w_t (-n.l)+/pi  (sr^-1).
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit

from relightcli.core.brdf.models import (
    COOK_TORRANCE,
    F0,
    LAMBERT,
    PHONG,
    ROUGHNESS,
    SHININESS,
    SPECULAR,
    TRANSLUCENT,
    TRANSMITTANCE,
    Triple,
    dot,
    lobes_and_density,
    schlick,
)

# A lobe whose Fresnel term vanishes at the mirror angle still reflects at others: it keeps this share of its weight.
_LEAST_FRESNEL = 0.1


@njit(cache=True, error_model="numpy")
def orthonormal_frame(n: Triple) -> tuple[Triple, Triple]:
    """Two unit vectors that complete the unit vector n to a right-handed frame. [Duff 2017, listing 3]"""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@njit(cache=True, error_model="numpy")
def about(axis: Triple, x: float, y: float, z: float) -> Triple:
    """The vector with coordinates (x, y, z) in a frame whose third axis is `axis`."""
    s, t = orthonormal_frame(axis)
    return (
        x * s[0] + y * t[0] + z * axis[0],
        x * s[1] + y * t[1] + z * axis[1],
        x * s[2] + y * t[2] + z * axis[2],
    )


@njit(cache=True, error_model="numpy")
def luminance(c: Triple) -> float:
    """Rec.709 luminance."""
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]


@njit(cache=True, error_model="numpy")
def lobe_probabilities(model: int, row: Any, albedo: Triple, nv: float) -> tuple[float, float, float]:
    """(w_d, w_s, w_t), summing to 1, or all 0 for a black material. nv: cosine of the viewer, above 0."""
    d = luminance(albedo)
    s = 0.0
    t = 0.0
    if model == TRANSLUCENT:
        t = luminance((row[TRANSMITTANCE], row[TRANSMITTANCE + 1], row[TRANSMITTANCE + 2]))
    elif model != LAMBERT:
        s = luminance((row[SPECULAR], row[SPECULAR + 1], row[SPECULAR + 2]))
        if model == COOK_TORRANCE:
            s *= max(schlick(row[F0], nv), _LEAST_FRESNEL)
    total = d + s + t
    if not total > 0.0:
        return 0.0, 0.0, 0.0
    return d / total, s / total, t / total


@njit(cache=True, error_model="numpy")
def sample_direction(
    model: int, row: Any, albedo: Triple, n: Triple, v: Triple, u1: float, u2: float
) -> tuple[Triple, bool]:
    """Draw l from u1, u2 in [0, 1): (unit l, usable). Not usable: black, n.v <= 0, or a lobe that went below n."""
    nv = dot(n, v)
    if not nv > 0.0:
        return n, False
    w_d, w_s, w_t = lobe_probabilities(model, row, albedo, nv)
    if w_d + w_s + w_t == 0.0:
        return n, False
    phi = 2.0 * math.pi * u2
    if w_s == 0.0 or u1 >= w_s:
        # The rest of u1 is uniform again within the lobe that it picked.
        side = 1.0
        if w_t > 0.0 and u1 < w_t:
            u = u1 / w_t
            side = -1.0
        else:
            u = (u1 - w_s - w_t) / w_d
        radius = math.sqrt(u)
        z = side * math.sqrt(max(0.0, 1.0 - u))
        return about(n, radius * math.cos(phi), radius * math.sin(phi), z), z != 0.0
    u = u1 / w_s
    if model == COOK_TORRANCE:
        tan2 = -row[ROUGHNESS] * row[ROUGHNESS] * math.log1p(-u)
    else:
        tan2 = math.expm1(-2.0 * math.log1p(-u) / (row[SHININESS] + 1.0))
    cosine = 1.0 / math.sqrt(1.0 + tan2)
    sine = math.sqrt(tan2) * cosine
    x, y = sine * math.cos(phi), sine * math.sin(phi)
    if model == PHONG:
        mirror = (2.0 * nv * n[0] - v[0], 2.0 * nv * n[1] - v[1], 2.0 * nv * n[2] - v[2])
        direction = about(mirror, x, y, cosine)
    else:
        h = about(n, x, y, cosine)
        vh = dot(v, h)
        direction = (2.0 * vh * h[0] - v[0], 2.0 * vh * h[1] - v[1], 2.0 * vh * h[2] - v[2])
    return direction, dot(n, direction) > 0.0


@njit(cache=True, error_model="numpy")
def evaluate_and_pdf(
    model: int,
    row: Any,
    albedo: Triple,
    n: Triple,
    l: Triple,  # noqa: E741
    v: Triple,
) -> tuple[Triple, float]:
    """(RGB of f |n.l|, density of `sample_direction` at l), both sr^-1."""
    d, s, t, q = lobes_and_density(model, row, n, l, v)
    w_d, w_s, w_t = lobe_probabilities(model, row, albedo, max(dot(n, v), 0.0))
    value = (
        albedo[0] * d + row[SPECULAR] * s + row[TRANSMITTANCE] * t,
        albedo[1] * d + row[SPECULAR + 1] * s + row[TRANSMITTANCE + 1] * t,
        albedo[2] * d + row[SPECULAR + 2] * s + row[TRANSMITTANCE + 2] * t,
    )
    return value, w_d * d + w_s * q + w_t * t

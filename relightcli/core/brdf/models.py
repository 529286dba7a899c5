"""The five reflectance models of a scene file: value, and the packed table that kernels read.

Every model has the same shape in colour: with `l` towards the light, `v` towards the viewer and `n` the shading normal,

    f(l, v) |n.l| = albedo d(l, v) + specular s(l, v) + transmittance t(l, v)        (sr^-1)

where d, s, t are scalars. `lobes` returns the three; `evaluate` puts the colours in. The cosine is part of the value,
because `phong` is defined with it, because `translucent` needs both its signs, and because the 1/(n.l) of
Cook-Torrance then cancels on paper. All are 0 unless n.v > 0, and all but t are 0 unless n.l > 0.

    lambert        d = (n.l)/pi
    blinn-phong    s = (n.l) (a+2)(a+4) / (8 pi (2^(-a/2) + a)) (n.h)^a     a = shininess   [Giesen 2009, exact at n=v]
    cook-torrance  s = F D G / (4 n.v)                                                      [Cook-Torrance 1982]
                   D = exp(-tan^2/m^2) / (pi m^2 cos^4), G = min(1, 2(n.h)(n.v)/(v.h), 2(n.h)(n.l)/(v.h)),
                   F = f0 + (1-f0)(1-v.h)^5                                 m = roughness   [Schlick 1994]
    phong          s = (a+1)/(2 pi) max(0, r.l)^a, r the mirror of v                        [Nowrouzezahrai 2008]
    translucent    t = max(0, -n.l)/pi

Narrow lobes are computed from tan^2 = |n x (l+v)|^2 / (n.(l+v))^2, never from a cosine near 1: one rounding of the
cosine changes cos^1e6 by 6 %. The functions are safe for roughness 1e-6 upwards and exponents 0 to 1e12, and at
grazing angles; they want float64 directions of unit length.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

Triple = tuple[float, float, float]

LAMBERT, BLINN_PHONG, COOK_TORRANCE, PHONG, TRANSLUCENT = range(5)
MODEL_CODES: dict[str, int] = {
    "lambert": LAMBERT,
    "blinn-phong": BLINN_PHONG,
    "cook-torrance": COOK_TORRANCE,
    "phong": PHONG,
    "translucent": TRANSLUCENT,
}

# Columns of a parameter row. NORMALISATION is the constant in front of the specular lobe.
DIFFUSE, SPECULAR, TRANSMITTANCE = 0, 3, 6
F0, ROUGHNESS, SHININESS, NORMALISATION = 9, 10, 11, 12
PARAMETERS = 13

# A Beckmann lobe this narrow is a mirror for every light that fits into a map; below, m^2 cos^4 leaves float64's range.
MINIMUM_ROUGHNESS = 1e-6

_INV_PI = 1.0 / math.pi


class MaterialLike(Protocol):
    """What `pack_materials` reads: `relightcli.scene.model.Material` has it."""

    @property
    def model(self) -> str: ...
    @property
    def diffuse(self) -> Triple: ...
    @property
    def specular(self) -> Triple: ...
    @property
    def transmittance(self) -> Triple: ...
    @property
    def f0(self) -> float: ...
    @property
    def roughness(self) -> float: ...
    @property
    def shininess(self) -> float: ...


@dataclass(frozen=True)
class MaterialTable:
    """Materials as kernels read them: `model` (M,) int32 codes, `parameters` (M, PARAMETERS) float64 rows."""

    model: NDArray[np.int32]
    parameters: NDArray[np.float64]


def pack_materials(materials: Iterable[MaterialLike]) -> MaterialTable:
    """One row per material, in order. Roughness below `MINIMUM_ROUGHNESS` is taken as that.

    Raises KeyError for an unknown model; values are trusted to be in range (the scene reader checks them).
    """
    codes: list[int] = []
    rows: list[list[float]] = []
    for material in materials:
        code = MODEL_CODES[material.model]
        roughness = max(float(material.roughness), MINIMUM_ROUGHNESS)
        a = float(material.shininess)
        codes.append(code)
        rows.append(
            [
                *material.diffuse,
                *material.specular,
                *material.transmittance,
                float(material.f0),
                roughness,
                a,
                _normalisation(code, roughness, a),
            ]
        )
    return MaterialTable(np.array(codes, np.int32), np.array(rows, np.float64).reshape(len(codes), PARAMETERS))


def _normalisation(code: int, roughness: float, a: float) -> float:
    """The constant in front of a specular lobe; 0 for a model without one."""
    if code == BLINN_PHONG:
        return (a + 2.0) * (a + 4.0) / (8.0 * math.pi * (2.0 ** (-0.5 * a) + a))
    if code == COOK_TORRANCE:
        return 1.0 / (math.pi * roughness * roughness)
    if code == PHONG:
        return (a + 1.0) / (2.0 * math.pi)
    return 0.0


def widen(table: MaterialTable, width: float) -> MaterialTable:
    """The table with specular lobes at least about `width` radians wide, in directions of light.

    Roughness is at least width / sqrt 2; exponents are at most 4 / width^2 about the half-vector, 1 / width^2 about the
    mirror direction: the standard deviation of the lobe is then `width`.
    """
    rows = table.parameters.copy()
    rows[:, ROUGHNESS] = np.maximum(rows[:, ROUGHNESS], width / math.sqrt(2.0))
    half = np.where(table.model == PHONG, 1.0, 4.0)
    rows[:, SHININESS] = np.minimum(rows[:, SHININESS], half / width**2)
    for code, row in zip(table.model, rows, strict=True):
        row[NORMALISATION] = _normalisation(int(code), row[ROUGHNESS], row[SHININESS])
    return MaterialTable(table.model, rows)


@njit(cache=True, error_model="numpy")
def dot(a: Triple, b: Triple) -> float:
    """Scalar product of two 3-tuples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy")
def tan2_between(a: Triple, b: Triple) -> float:
    """Squared tangent of the angle between two directions of any length, exact for small angles; inf at 90 degrees."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    c = dot(a, b)
    return (x * x + y * y + z * z) / (c * c)


@njit(cache=True, error_model="numpy")
def schlick(f0: float, cosine: float) -> float:
    """Schlick's Fresnel term F = f0 + (1-f0)(1-cosine)^5. [Schlick 1994]"""
    x = max(0.0, 1.0 - cosine)
    x2 = x * x
    return f0 + (1.0 - f0) * x2 * x2 * x


@njit(cache=True, error_model="numpy")
def lobes_and_density(model: int, row: Any, n: Triple, l: Triple, v: Triple) -> tuple[float, float, float, float]:  # noqa: E741
    """(d, s, t, q): the three lobes of the module's formula, and the density q of sampling l from the specular lobe.

    q (sr^-1) belongs to `sampling.sample_direction`: D (n.h) / (4 v.h) for the half-vector lobes, the lobe itself for
    phong; it counts directions below the surface too, which the sampler then rejects.
    """
    nv = dot(n, v)
    if not nv > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    nl = dot(n, l)
    d = max(nl, 0.0) * _INV_PI
    if model == LAMBERT:
        return d, 0.0, 0.0, 0.0
    if model == TRANSLUCENT:
        return d, 0.0, max(-nl, 0.0) * _INV_PI, 0.0
    if not nl > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    if model == PHONG:
        r = (2.0 * nv * n[0] - v[0], 2.0 * nv * n[1] - v[1], 2.0 * nv * n[2] - v[2])
        if not dot(r, l) > 0.0:
            return d, 0.0, 0.0, 0.0
        s = row[NORMALISATION] * math.exp(-0.5 * row[SHININESS] * math.log1p(tan2_between(r, l)))
        return d, s, 0.0, s

    half = (l[0] + v[0], l[1] + v[1], l[2] + v[2])
    length2 = dot(half, half)
    nh_length = nl + nv  # n.h |l+v|
    if not (length2 > 0.0 and nh_length * nh_length > 0.0):
        return d, 0.0, 0.0, 0.0
    vh = min(1.0, 0.5 * math.sqrt(length2))
    ratio = 2.0 * nh_length / length2  # (n.h)/(v.h)
    tan2 = tan2_between(n, half)
    if model == BLINN_PHONG:
        a = row[SHININESS]
        power = math.exp(-0.5 * a * math.log1p(tan2))
        # q = (a+1)/(2 pi) (n.h)^a / (4 v.h)
        return d, row[NORMALISATION] * power * nl, 0.0, (a + 1.0) * power / (8.0 * math.pi * vh)
    m = row[ROUGHNESS]
    # 1/cos^4 = (1 + tan^2)^2; one exponential of the sum neither overflows nor becomes 0/0 as n.h -> 0.
    beckmann = row[NORMALISATION] * math.exp(2.0 * math.log1p(tan2) - tan2 / (m * m))
    # G / (4 n.v): min(1, 2 (n.h) min(n.l, n.v) / (v.h)) / (4 n.v), with the divisions by n.v taken out
    geometry = min(0.25 / nv, 0.5 * ratio * min(1.0, nl / nv))
    s = schlick(row[F0], vh) * beckmann * geometry
    return d, s, 0.0, 0.25 * beckmann * ratio


@njit(cache=True, error_model="numpy")
def lobes(model: int, row: Any, n: Triple, l: Triple, v: Triple) -> tuple[float, float, float]:  # noqa: E741
    """(d, s, t), sr^-1: f |n.l| = albedo d + specular s + transmittance t.

    model: code; row: (PARAMETERS,) float64; n, l, v: 3-tuples of float64, unit, away from the surface.
    """
    d, s, t, _ = lobes_and_density(model, row, n, l, v)
    return d, s, t


@njit(cache=True, error_model="numpy")
def evaluate(model: int, row: Any, albedo: Triple, n: Triple, l: Triple, v: Triple) -> Triple:  # noqa: E741
    """RGB of f |n.l| (sr^-1). `albedo` is the diffuse colour with its texture; the row's own DIFFUSE is not read."""
    d, s, t, _ = lobes_and_density(model, row, n, l, v)
    return (
        albedo[0] * d + row[SPECULAR] * s + row[TRANSMITTANCE] * t,
        albedo[1] * d + row[SPECULAR + 1] * s + row[TRANSMITTANCE + 1] * t,
        albedo[2] * d + row[SPECULAR + 2] * s + row[TRANSMITTANCE + 2] * t,
    )


def evaluate_many(
    table: MaterialTable,
    material: NDArray[np.integer[Any]],
    albedo: NDArray[np.floating[Any]],
    normal: NDArray[np.floating[Any]],
    light: NDArray[np.floating[Any]],
    view: NDArray[np.floating[Any]],
) -> NDArray[np.float64]:
    """f |n.l| (..., 3) float64, sr^-1, for arrays that broadcast: `material` (...), the others (..., 3)."""
    shape = np.broadcast_shapes(
        (*np.shape(material), 3), np.shape(albedo), np.shape(normal), np.shape(light), np.shape(view)
    )
    colours, normals, lights, views = (
        np.ascontiguousarray(np.broadcast_to(x, shape), np.float64).reshape(-1, 3)
        for x in (albedo, normal, light, view)
    )
    index = np.ascontiguousarray(np.broadcast_to(material, shape[:-1]), np.int64).reshape(-1)
    out = np.empty((len(index), 3))
    _evaluate_rows(table.model, table.parameters, index, colours, normals, lights, views, out)
    return out.reshape(shape)


@njit(cache=True, error_model="numpy")
def _evaluate_rows(
    model: Any, parameters: Any, material: Any, albedo: Any, normal: Any, light: Any, view: Any, out: Any
) -> None:
    for i in range(len(material)):
        k = material[i]
        out[i, 0], out[i, 1], out[i, 2] = evaluate(
            model[k],
            parameters[k],
            (albedo[i, 0], albedo[i, 1], albedo[i, 2]),
            (normal[i, 0], normal[i, 1], normal[i, 2]),
            (light[i, 0], light[i, 1], light[i, 2]),
            (view[i, 0], view[i, 1], view[i, 2]),
        )

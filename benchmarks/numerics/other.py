"""Small kernels here and there: display values, skinning, mixes of materials, weights of estimators."""

from __future__ import annotations

import numpy as np

from benchmarks.numerics.case import case, directions, mp, mpf, numbers, powers, relative, unit
from benchmarks.numerics.sphere import ROUNDINGS


@case("display values", "display.py", "1e-30 to 1, both sides of the knee, and back", "float32", 1.0, ROUNDINGS)
def srgb():
    from relightcli.core.display import decode_srgb, encode_srgb

    x = np.array([0.0, 1e-30, 1e-4, 0.0031307, 0.0031309, 0.01, 0.18, 0.7, 1.0], np.float32)
    there = []
    for value in mpf(x):
        low = value <= mp.mpf("0.0031308")
        there.append(value * mp.mpf("12.92") if low else mp.mpf("1.055") * value ** (mp.mpf(5) / 12) - mp.mpf("0.055"))
    y = np.array([0.0, 1e-30, 0.04, 0.0405, 0.2, 1.0], np.float32)
    back = []
    for value in mpf(y):
        low = value <= mp.mpf("0.04045")
        back.append(value / mp.mpf("12.92") if low else ((value + mp.mpf("0.055")) / mp.mpf("1.055")) ** mp.mpf("2.4"))
    return np.concatenate([relative(encode_srgb(x), numbers(there)), relative(decode_srgb(y), numbers(back))])


@case("normals of a skin", "pose/rig.py", "joints scaled 1e-3 : 1 : 1e3, weights 1 and 1e-6", "float64", 2.0, ROUNDINGS)
def skin():
    from relightcli.core.pose.rig import blend

    rng = np.random.default_rng(3)
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[0, :3, :3] = np.diag([1e-3, 1.0, 1e3])
    matrices[1, :3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    n = np.abs(directions(6, 1))
    t = np.cross(n, [0.3, 0.1, -0.9])
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    joint = np.tile(np.array([[0, 1]], np.int32), (6, 1))
    weight = np.where(np.arange(6)[:, None] % 2, [[1.0, 0.0]], [[1 - 1e-6, 1e-6]])
    _, normal, tangent = blend(n, n, t, joint, weight, matrices)
    errors = []
    for k in range(6):
        m = mp.matrix(3, 3)
        for i in range(3):
            for j in range(3):
                m[i, j] = mp.fsum(mp.mpf(weight[k, w]) * mp.mpf(matrices[w, i, j]) for w in range(2))
        inverse = m**-1
        exact = unit([mp.fsum(inverse[i, j] * mp.mpf(n[k, i]) for i in range(3)) for j in range(3)])
        errors.append(relative(normal[k], numbers(exact), 1.0))
        errors.append(np.full(3, abs(float(normal[k] @ tangent[k]))))
    return np.stack(errors)


@case(
    "the open hemisphere",
    "pose/visibility.py",
    "order 8",
    "float64",
    2.6,
    "constants of the harmonics; relative to band 0",
)
def hemisphere():
    from relightcli.core.pose.visibility import hemisphere_harmonics

    exact = [mp.mpf(0)] * 64
    for band in range(8):
        whole = mp.fsum(c / (k + 1) for k, c in enumerate(powers(band)))
        exact[band * (band + 1)] = 2 * mp.pi * mp.sqrt((2 * band + 1) / (4 * mp.pi)) * whole
    return relative(hemisphere_harmonics(8), numbers(exact), exact[0])


@case(
    "mix between materials",
    "brdf/navigation.py",
    "roughness 1e-4 to 10, points 1e-7 beside an entry",
    "float64",
    1.5,
    "a system of two rows in a plane scaled to 1; what the weights give back, relative to the range of a parameter",
)
def mixes():
    from relightcli.core.brdf.navigation import exponent_mix, fresnel_roughness_mix

    points = np.array([[0.0, 1e-4], [1.0, 1e-4], [0.0, 10.0], [1.0, 10.0], [0.4, 0.2]])
    errors = []
    for f0, roughness in ((0.3, 0.01), (0.4 + 1e-7, 0.2), (0.999, 9.9), (1e-9, 1e-4), (0.7, 1.0)):
        w = fresnel_roughness_mix(points, f0, roughness).weights
        errors.append(relative(np.array(w.sum()), mp.mpf(1)))
        errors.append(np.array(abs(w @ points[:, 0] - f0)))
        errors.append(np.array(abs(w @ np.log(points[:, 1]) - np.log(roughness)) / np.log(1e5)))
    exponents = np.array([1.0, 10.0, 1e6])
    for x in (1.0 + 1e-9, 5.0, 999999.0):
        w = exponent_mix(exponents, x).weights
        errors.append(np.array(abs(w @ exponents - x) / x))
    return np.array(errors)


@case("weights of two estimators", "transport/estimators.py", "densities 1e-200 to 1e200", "float64", 1.0, ROUNDINGS)
def heuristic():
    from relightcli.core.transport.estimators import _power_heuristic

    errors = []
    for p, q in ((1.0, 1.0), (1e-200, 1e200), (1e200, 1e-200), (3.0, 0.0), (0.1, 1e5), (1e-3, 1e-5)):
        exact = mp.mpf(p) ** 2 / (mp.mpf(p) ** 2 + mp.mpf(q) ** 2)
        # Below 1e-300 nothing is as good as the weight itself.
        errors.append(relative(np.array(_power_heuristic(p, q)), exact, max(exact, mp.mpf("1e-300"))))
    return np.array(errors)


@case("sites around a point", "fields/sites.py", "at a site, 1e-9 beside it, 1e6 away", "float32", 0.7, ROUNDINGS)
def sites():
    from relightcli.core.fields.sites import between

    place = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0], [5, 5, 5]])
    points = np.array([[0.0, 0, 0], [1 + 1e-9, 0, 0], [0.3, 0.2, 0.1], [1e6, 0, 0]])
    found = between(points, place)
    errors = []
    for p, index, weight in zip(points, found.site, found.weight, strict=True):
        square = [mp.fsum((x - y) ** 2 for x, y in zip(mpf(p), mpf(place[k]), strict=True)) for k in index]
        if square[0] == 0:
            exact = [mp.mpf(s == 0) for s in square]
        else:
            exact = [1 / s for s in square]
            exact = [e / mp.fsum(exact) for e in exact]
        errors.append(relative(weight, numbers(exact), 1.0))
    return np.stack(errors)

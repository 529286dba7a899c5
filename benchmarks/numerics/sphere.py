"""Spheres and plain geometry: cube maps, harmonics, rotations, triple products, wavelets, normals, affine maps."""

from __future__ import annotations

import numpy as np

from benchmarks.numerics.case import (
    case,
    directions,
    dot,
    harmonics,
    legendre,
    mp,
    mpf,
    norm,
    numbers,
    powers,
    relative,
    times,
    unit,
)

ROUNDINGS = "a handful of roundings of the type it is stored in"


def corner_angle(x, y):
    return mp.atan2(x * y, mp.sqrt(x * x + y * y + 1))


def rectangle(s0, s1, t0, t1):
    return corner_angle(s1, t1) - corner_angle(s0, t1) - corner_angle(s1, t0) + corner_angle(s0, t0)


@case("solid angle of cube texels", "sphere/cube.py", "1 to 1024 texels a side", "float64", 1.3, ROUNDINGS)
def texels():
    from relightcli.core.sphere import cube

    errors = []
    for resolution in (1, 2, 3, 7, 64, 1024):
        found = cube.solid_angles(resolution)
        pick = sorted({0, 1 % resolution, resolution // 2, resolution - 1})
        edge = [mp.mpf(2 * k - resolution) / resolution for k in range(resolution + 1)]
        exact = numbers(
            (rectangle(edge[j], edge[j + 1], edge[i], edge[i + 1]) for i in pick for j in pick), (len(pick),) * 2
        )
        errors.append(relative(found[np.ix_(pick, pick)], exact).reshape(-1))
    return np.concatenate(errors)


@case(
    "solid angle of quadtree cells",
    "lights/quadtree.py",
    "faces to single texels of 4096 and 1000 a side",
    "float64",
    1.3,
    ROUNDINGS,
)
def cells():
    from relightcli.core.lights.quadtree import solid_angles

    errors = []
    for resolution in (4096, 1000):
        rng, found = np.random.default_rng(0), []
        for size in (1, 2, 37, 256, resolution):
            for _ in range(20):
                r, c = rng.integers(0, resolution - size + 1, 2)
                found.append((0, r, r + size, c, c + size))
        exact = numbers(
            rectangle(*(mp.mpf(2 * int(x) - resolution) / resolution for x in (c0, c1, r0, r1)))
            for _, r0, r1, c0, c1 in found
        )
        errors.append(relative(solid_angles(np.array(found), resolution), exact))
    return np.concatenate(errors)


@case(
    "spherical harmonics",
    "sphere/sh.py",
    "order 10; anywhere, and within 1e-8 of the poles",
    "float64",
    2.6,
    "differences of the bands below, nine times over; relative to the largest value of the band",
)
def values():
    from relightcli.core.sphere import sh

    d = np.concatenate([directions(12, 1), directions(6, 2, 1e-2), directions(6, 3, 1e-8), np.eye(3), -np.eye(3)])
    band = np.repeat(np.arange(10), 2 * np.arange(10) + 1)
    exact = np.stack([numbers(harmonics(x, 10)) for x in d.tolist()])
    return relative(sh.harmonics(d, 10), exact, np.sqrt((2 * band + 1) / (4 * np.pi)))


@case(
    "sky into harmonics",
    "sphere/sh.py",
    "a texel of 1e12 beside a sky of 1e-3",
    "float64",
    2.6,
    "those of the harmonics; relative to the sum of the fluxes times the largest value of the band",
)
def sky():
    from relightcli.core.sphere import cube, sh

    flux = np.full((6 * 64, 3), 1e-3)
    flux[17] = 1e12
    d = cube.texel_directions(8).reshape(-1, 3)
    y = np.stack([numbers(harmonics(x, 4)) for x in d.tolist()])
    exact = (y.T @ mpf(flux)).astype(object)
    band = np.repeat(np.arange(4), 2 * np.arange(4) + 1)
    return relative(sh.project_sky(flux, 8, 4), exact, np.outer(np.sqrt((2 * band + 1) / (4 * np.pi)), flux.sum(0)))


@case(
    "bits to harmonics",
    "sphere/sh.py",
    "runs of 1 to 64 texels, order 6",
    "float32",
    1.0,
    "a float32 basis, summed in float64; relative to the sum of the terms' sizes",
)
def bits():
    from relightcli.core.sphere import cube, sh

    rng = np.random.default_rng(5)
    packed = rng.integers(0, 256, (4, 6, 16, 2), dtype=np.uint8)
    packed[1] = 255
    packed[2] &= 0x0F
    normals = directions(4, 6).astype(np.float32)
    found = sh.cosine_transfer(packed, normals, 6)
    d = cube.texel_directions(16).reshape(-1, 3)
    area = np.tile(cube.solid_angles(16).reshape(-1), 6)
    y = sh.harmonics(d, 6)
    bit = np.unpackbits(packed.reshape(4, -1), axis=1, bitorder="little")
    errors = []
    for i in range(4):
        weight = (d @ normals[i].astype(np.float64)) * area * bit[i] / np.pi
        terms = weight[:, None] * y
        exact = numbers(mp.fsum(column.tolist()) for column in terms.T)
        errors.append(relative(found[i], exact, np.abs(terms).sum(0)))
    return np.stack(errors)


@case(
    "rotation of harmonics",
    "sphere/rotation.py",
    "order 8; by 0, 1e-9, 180 degrees and any turn; mirrored",
    "float64",
    2.6,
    "those of the harmonics, twice; relative to the function's largest value",
)
def rotation():
    from relightcli.core.affine import compose
    from relightcli.core.sphere.rotation import rotation_matrices

    turns = [
        compose(np.zeros(3), np.array(a, float), g, np.ones(3))[:3, :3]
        for a, g in (((0, 0, 1), 0), ((1, 2, 3), 6e-8), ((0, 1, 0), 180), ((1, 1, 1), 180), ((3, -1, 2), 77))
    ]
    turns.append(-turns[-1])
    matrices = rotation_matrices(np.stack(turns), 8)
    errors = []
    for turn, matrix in zip(turns, matrices, strict=True):
        for d in directions(4, 7).tolist():
            back = [dot(mpf(turn[:, k]), mpf(d)) for k in range(3)]
            exact = numbers(harmonics(back, 8))
            found = numbers(harmonics(d, 8)) @ mpf(matrix)
            errors.append([float(abs(x)) for x in (found - exact)])
    return np.array(errors) / np.sqrt(64 / (4 * np.pi))


@case(
    "triple product coefficients",
    "sphere/triple_product.py",
    "all of order 4",
    "float64",
    2.9,
    "those of the harmonics, three times",
)
def triples():
    from relightcli.core.sphere.rotation import quadrature
    from relightcli.core.sphere.triple_product import coefficients

    found = coefficients(4)
    # Another rule than the kernel's: 8 Gauss points, polished to the reference's precision.
    z, _ = np.polynomial.legendre.leggauss(8)
    nodes = [mp.findroot(lambda t: legendre(8, t), x) for x in z]
    weights = [2 * (1 - t * t) / (8 * legendre(7, t)) ** 2 for t in nodes]
    rows, area = [], []
    for t, w in zip(nodes, weights, strict=True):
        for k in range(11):
            phi = 2 * mp.pi * (k + mp.mpf(1) / 3) / 11
            r = mp.sqrt(1 - t * t)
            rows.append(harmonics((r * mp.cos(phi), r * mp.sin(phi), t), 4))
            area.append(w * 2 * mp.pi / 11)
    y, w = np.array(rows, object), np.array(area, object)
    pick = np.flatnonzero((found.i <= found.j) & (found.j <= found.k))
    exact = numbers((w * y[:, i] * y[:, j] * y[:, k]).sum() for i, j, k in np.stack(found[:3], 1)[pick].tolist())
    total = quadrature(4)[1].sum()
    return np.append(relative(found.value[pick], exact), abs(total / (4 * np.pi) - 1))


@case(
    "triple products in a chain",
    "sphere/triple_product.py",
    "50 windowed occluders, order 4",
    "float64",
    3.0,
    "50 products, each a few roundings of its matrix; relative to the result's norm",
)
def chain():
    found, exact, _ = _chain()
    return relative(found, exact, norm(exact))


def _chain():
    """50 products of windowed visibilities in float64, and exactly with the same coefficients; the factors."""
    from relightcli.core.sphere.triple_product import coefficients, product
    from relightcli.core.sphere.window import window

    table = coefficients(4)
    rng = np.random.default_rng(3)
    factors = 0.15 * rng.standard_normal((50, 16)) * window(4)
    factors[:, 0] = np.sqrt(4 * np.pi) * 0.98
    light = rng.random(16)
    found, exact = light, list(mpf(light))
    terms = list(zip(*(x.tolist() for x in table), strict=True))
    for factor in factors:
        found = product(factor, found)
        out = [mp.mpf(0)] * 16
        own = mpf(factor)
        for i, j, k, value in terms:
            out[k] += mp.mpf(value) * own[i] * exact[j]
        exact = out
    return found, numbers(exact), (factors, light)


@case(
    "chain of occlusion fields",
    "fields/chain.py",
    "50 occluders, order 4",
    "float32",
    2.3,
    "50 products in float32; relative to the result's norm",
)
def field_chain():
    from relightcli.core.fields.chain import light_at
    from relightcli.core.fields.entities import Lookup

    _, exact, (factors, light) = _chain()
    single = factors.astype(np.float32)
    rows = np.zeros((50, 4, 16), np.float32)
    rows[:, 0] = single
    weight = np.zeros((1, 50, 8), np.float32)
    weight[..., 0] = 1.0
    place = np.zeros((1, 50, 8), np.int32)
    place[0, :, 0] = np.arange(50)
    nearest = np.arange(49, -1, -1, dtype=np.int32)[None]
    empty = np.zeros(0, np.int32)
    lookup = Lookup(**dict.fromkeys(Lookup._fields, empty) | {"place": place, "weight": weight, "nearest": nearest})
    found = light_at(lookup, rows, np.tile(light, (3, 1)))[0, 0]
    return relative(found, exact, norm(exact))


@case(
    "window against ringing",
    "sphere/window.py",
    "orders 2 to 10",
    "float64",
    2.5,
    "roots by an eigenvalue problem, and their differences; relative to band 0",
)
def windows():
    from relightcli.core.sphere.window import window

    errors = []
    for order in range(2, 11):
        odd, points = (order - 1) % 2, (order - 1) // 2 + 1

        # P_n, or with a factor 1 + t the Jacobi polynomial for the weight 1 + t.
        def polynomial(t, n=points, odd=odd):
            return legendre(n, t) + legendre(n + 1, t) if odd else legendre(n, t)

        guess = [x for x in _roots(points, odd) if x > -1.0 + 1e-9]
        roots = [mp.findroot(polynomial, x) for x in guess]
        # The kernel as a polynomial: its Legendre means are exact.
        kernel = [mp.mpf(1)]
        for r in roots[:-1]:
            for _ in range(2):
                kernel = times(kernel, [-r, mp.mpf(1)])
        kernel = times(kernel, [mp.mpf(1)] * (1 + odd))
        means = []
        for band in range(order):
            product = times(kernel, powers(band))
            means.append(mp.fsum(2 * c / (k + 1) for k, c in enumerate(product) if k % 2 == 0))
        found = window(order)[np.arange(order) ** 2]
        errors.append(relative(found, numbers(m / means[0] for m in means), 1.0))
    return np.concatenate(errors)


def _roots(points, odd):
    """About where they are, rising."""
    series = np.zeros(points + 1 + odd)
    series[points:] = 1.0
    return np.sort(np.polynomial.legendre.legroots(series).real)


@case(
    "Haar wavelets, there and back",
    "sphere/haar.py",
    "a texel of 1e6 beside 1e-3, 32 a side",
    "float64",
    1.5,
    "five levels of sums of four; relative to the face's norm",
)
def haar():
    from relightcli.core.sphere.haar import forward, inverse

    face = np.random.default_rng(2).random((1, 32, 32)) * 1e-3
    face[0, 5, 9] = 1e6
    exact = [mpf(face[0])]
    while exact[-1].shape[0] > 1:
        b = exact[-1]
        exact.append((b[::2, ::2] + b[1::2, ::2] + b[::2, 1::2] + b[1::2, 1::2]) / 2)
    found = forward(face)[0]
    norm2 = float(np.sqrt((face**2).sum()))
    there = [relative(found[:1, :1], exact[-1], norm2).reshape(-1)]
    for level in range(5):
        half, b = 1 << level, exact[4 - level]
        across = (b[::2, ::2] - b[::2, 1::2] + b[1::2, ::2] - b[1::2, 1::2]) / 2
        there.append(relative(found[:half, half : 2 * half], across, norm2).reshape(-1))
    return np.concatenate([*there, np.abs(inverse(found) - face[0]).reshape(-1) / norm2])


@case(
    "share of a truncation",
    "sphere/haar.py",
    "shares from 1e-1 to 1e-14 of the energy",
    "float32",
    1.3,
    "sums in float64 of float32 coefficients of two roundings each, but for what cancels in them",
)
def truncation():
    from relightcli.core.sphere import cube, haar

    bits = np.full((1, 6, 8, 1), 255, np.uint8)
    normal = directions(1, 8).astype(np.float32)
    d = cube.texel_directions(8).reshape(-1, 3).astype(np.float32)
    # Nearly even light: its details are small beside the mean.
    area = cube.solid_angles(8).reshape(-1).astype(np.float32)
    errors = []
    for count in (6, 40, 160, 320):
        _, _, dropped = haar.truncated_cosine_transfer(bits, normal, d, area, count, by_area=False)
        _, value, _ = haar.truncated_cosine_transfer(bits, normal, d, area, 384, by_area=False)
        squares = mpf(value[0]) ** 2
        exact = mp.fsum(squares[count:]) / mp.fsum(squares)
        errors.append(relative(dropped, numbers([exact]))[0])
    return np.array(errors)


@case(
    "turns about an axis (Rodrigues)",
    "affine.py",
    "1e-9 to 180 degrees, and their opposites",
    "float64",
    1.3,
    "a sine, a squared half sine, products; entries off the diagonal elementwise",
)
def rodrigues():
    from relightcli.core.affine import compose

    errors = []
    for degrees in (1e-9, 1e-5, 0.1, 45, 90, 179.9999999, 180, -1e-7, 359.999, 720.5):
        for axis in ([1.0, 2.0, 3.0], [1e-9, 1.0, 0.0], [1e12, 1e12, -1e12]):
            found = compose(np.zeros(3), np.array(axis), degrees, np.ones(3))[:3, :3]
            x, y, z = unit(mpf(axis))
            a = mp.radians(mp.mpf(degrees))
            c, s, h = mp.cos(a), mp.sin(a), 2 * mp.sin(a / 2) ** 2
            exact = np.array(
                [
                    [c + h * x * x, h * x * y - s * z, h * x * z + s * y],
                    [h * x * y + s * z, c + h * y * y, h * y * z - s * x],
                    [h * x * z - s * y, h * y * z + s * x, c + h * z * z],
                ],
                object,
            )
            # What is small by its axis alone, or 0 by symmetry, is held against the turn's sine.
            scale = np.where(np.eye(3, dtype=bool), 1.0, max(float(abs(s)), float(h), 1e-300) / 4)
            errors.append(relative(found, exact, scale))
    return np.stack(errors)


@case(
    "normals and unit vectors",
    "affine.py",
    "lengths 1e-300 to 1e300, scales 1e-6 : 1 : 1e6",
    "float64",
    1.5,
    ROUNDINGS + "; relative to the unit length",
)
def units():
    from relightcli.core.affine import normal_matrix
    from relightcli.core.affine import unit as kernel

    d = directions(12, 4) * 10.0 ** np.linspace(-300, 300, 12)[:, None]
    exact = np.stack([numbers(unit(mpf(x))) for x in d])
    first = relative(kernel(d), exact, 1.0)
    m = np.diag([1e-6, 1.0, 1e6]) @ np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    n = directions(12, 9)
    inverse = mp.matrix(m.tolist()) ** -1
    exact = np.stack([numbers(unit([dot([inverse[k, i] for k in range(3)], mpf(x)) for i in range(3)])) for x in n])
    return np.concatenate([first, relative(kernel(n @ normal_matrix(m).T), exact, 1.0) / _condition(m, n)])


def _condition(m, n):
    """How much the inverse transpose stretches its largest terms beyond what is left, (N, 1)."""
    inverse = np.abs(np.linalg.inv(m).T)
    return ((np.abs(n) @ inverse.T).max(1) / np.linalg.norm(n @ np.linalg.inv(m), axis=1))[:, None].clip(1)


@case(
    "vertex normals",
    "normals.py",
    "slivers of 1e-9, size 1e-6, 1e6 away from the origin",
    "float64",
    1.6,
    "corner angles by atan2, cross products; differences of coordinates are exact",
)
def vertex():
    from relightcli.core.normals import vertex_normals

    errors = []
    for shift, size in ((0.0, 1.0), (0.0, 1e-6), (1.0, 2.0**-20), (2.0**20, 1.0)):
        p = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5], [-1, 2.0**-30, 0], [0.3, -1, 0.2]]) * size + shift
        faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], np.int32)
        found = vertex_normals(p, faces)[0]
        total = [mp.mpf(0)] * 3
        for _, j, k in faces:
            a, b = mpf(p[j]) - mpf(p[0]), mpf(p[k]) - mpf(p[0])
            cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
            angle = mp.atan2(norm(cross), dot(a, b))
            total = [t + angle * x for t, x in zip(total, unit(cross), strict=True)]
        errors.append(relative(found, numbers(unit(total)), 1.0))
    return np.stack(errors)


@case(
    "even points of the square",
    "sphere/lattice.py",
    "points 0 to 4095",
    "float64",
    3.7,
    "the fractional part of k times a constant: as many digits as k has",
)
def lattice():
    from relightcli.core.sphere.lattice import r2_point

    g = mp.findroot(lambda t: t**3 - t - 1, 1.3)
    errors = []
    for k in (0, 1, 2, 3, 10, 100, 1000, 4095):
        exact = [(mp.mpf(1) / 2 + k / g**n) % 1 for n in (1, 2)]
        errors.append(relative(np.array(r2_point(k)), numbers(exact), 1.0))
    return np.stack(errors)

"""What moves: fields and their samples, poses, lobes, quaternions, linear models; cameras, receivers, and errors."""

from __future__ import annotations

import math

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
from benchmarks.numerics.sphere import ROUNDINGS

SINGLE = "a few roundings of float32"


@case(
    "field of a sphere in closed form",
    "fields/sources.py",
    "from 1 + 1e-6 to 1e6 radii away, order 6",
    "float64",
    3.2,
    "next to the surface the distance's own rounding over the root of its rest, 1e-3; relative to the solid angle "
    "times the largest value of the band",
)
def discs():
    from relightcli.core.fields.sources import disc_light

    errors = []
    band = np.repeat(np.arange(6), 2 * np.arange(6) + 1)
    for distance in (1.0 + 2.0**-20, 1.02, 2.0, 8.0, 1e3, 1e6):
        to = directions(1, 4)[0] * distance
        found = disc_light(to[None], 1.0, 6)[0]
        r = norm(mpf(to))
        c = mp.sqrt(1 - 1 / r**2)
        whole = [2 * mp.pi * (1 - c)]
        whole += [2 * mp.pi * (legendre(b - 1, c) - legendre(b + 1, c)) / (2 * b + 1) for b in range(1, 6)]
        exact = numbers(y * whole[b] for y, b in zip(harmonics(to, 6), band.tolist(), strict=True))
        scale = numbers(whole[0] * mp.sqrt((2 * int(b) + 1) / (4 * mp.pi)) for b in band)
        errors.append(relative(found, exact, scale))
    return np.stack(errors)


@case(
    "field of a rectangle",
    "fields/sources.py",
    "2 to 1e4 radii away, order 4",
    "float64",
    2.6,
    "Gauss points of its area; relative to the rectangle's solid angle",
)
def rectangles():
    from relightcli.core.fields.sources import FAR_NODES, rectangle_light

    u, v = np.array([1.0, 0, 0.0]), np.array([0.0, 0.7, 0.0])
    nodes, _ = np.polynomial.legendre.leggauss(30)
    fine = [mp.findroot(lambda t: legendre(30, t), x) for x in nodes]
    area = [2 * (1 - t * t) / (30 * legendre(29, t)) ** 2 for t in fine]
    errors = []
    for distance in (2.0, 1e4):
        p = np.array([0.3, -0.2, 1.0]) / math.sqrt(1.13) * distance
        found = rectangle_light(p[None], u, v, 4, FAR_NODES)[0]
        total = [mp.mpf(0)] * 16
        size = mp.mpf(0)
        for x, wx in zip(fine, area, strict=True):
            for y, wy in zip(fine[:], area, strict=True):
                way = [x / 2 - mp.mpf(p[0]), y * mp.mpf(0.7) / 2 - mp.mpf(p[1]), -mp.mpf(p[2])]
                r = norm(way)
                flux = wx * wy / 4 * mp.mpf(0.7) * -way[2] / r**3
                size += flux
                if distance > 10 and (x not in fine[::6] or y not in fine[::6]):
                    continue
                total = [t + flux * h for t, h in zip(total, harmonics(way, 4), strict=True)]
        if distance <= 10:
            errors.append(relative(found, numbers(total), size))
        else:
            errors.append(relative(found[:1], numbers([size * mp.sqrt(1 / (4 * mp.pi))]), size))
    return np.concatenate(errors)


@case("bands of the clamped cosine", "fields/body.py", "order 16", "float64", 1.0, ROUNDINGS)
def cosine():
    from relightcli.core.fields.body import clamped_cosine

    found = clamped_cosine(16)[np.arange(16) ** 2]
    exact = [2 * mp.pi * mp.fsum(x / (k + 2) for k, x in enumerate(powers(band))) for band in range(16)]
    odd = (np.arange(16) % 2 == 1) & (np.arange(16) > 1)
    return relative(found, numbers(exact), np.where(odd, 1.0, np.abs(found)))


@case(
    "places between a field's samples",
    "fields/interpolate.py",
    "within the shells, on them, inside, 1e6 outside",
    "float32",
    1.0,
    SINGLE,
)
def places():
    from relightcli.core.fields.field import shell_radii
    from relightcli.core.fields.interpolate import locate, make_grid

    errors = []
    for spacing in ("geometric", "paper"):
        radii = shell_radii(0.5, 6, spacing)
        grid = make_grid(radii, 4)
        distances = [0.01, *radii, *(radii * (1 + 1e-12)), *np.sqrt(radii[1:] * radii[:-1]), 100.0, 5e5]
        for k, distance in enumerate(distances):
            p = directions(1, k)[0] * distance
            index, weight = locate(grid, p[None])
            r = norm(mpf(p))
            shell = index[0].astype(int) // (6 * 16)
            low = min(int(np.searchsorted(radii, float(r), side="right")) - 1, 4)
            if r <= radii[0]:
                along, low = {0: mp.mpf(1)}, 0
            elif r >= radii[-1]:
                along = {5: (mp.mpf(radii[-1]) / r) ** 2}
            else:
                a, b = mp.mpf(radii[low]), mp.mpf(radii[low + 1])
                t = mp.log(r / a) / mp.log(b / a) if spacing == "geometric" else (r - a) / (b - a)
                along = {low: 1 - t, low + 1: t}
            for s in range(6):
                found = float(weight[0][shell == s].astype(np.float64).sum())
                errors.append(relative(np.array(found), mp.mpf(along.get(s, 0)), max(along.values())))
    return np.array(errors)


@case(
    "weights of proxies",
    "fields/proxies.py",
    "at a proxy, 1e-5 beside it, far away, all in micrometres",
    "float64",
    1.5,
    ROUNDINGS + " of differences of coordinates",
)
def proxies():
    from relightcli.core.fields.proxies import POWER, proxy_weights

    errors = []
    for scale in (1.0, 2.0**-20):
        chi = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0.5]]) * scale
        points = np.array([[1e-5, 0, 0], [0.3, 0.3, 0.1], [1e4, 2e4, 1e3]]) * scale
        found = proxy_weights(points, chi, scale)
        for p, row in zip(points, found, strict=True):
            inverse = [1 / norm(mpf(p) - mpf(c)) ** POWER for c in chi]
            errors.append(relative(row, numbers(w / mp.fsum(inverse) for w in inverse)))
    return np.stack(errors)


@case(
    "rays through a distant sphere",
    "fields/sampling.py",
    "1.001 to 1e6 radii away",
    "float64",
    2.0,
    "1 - cos of the cone without a difference but 1 - sin^2; relative to a ray's solid angle",
)
def rays():
    from relightcli.core.fields.sampling import cone_rays

    errors = []
    for distance in (1.001, 2.0, 1e3, 1e6):
        _, weight = cone_rays(np.array([[0.0, 0.0, distance]]), np.zeros(3), 1.0, 8, 0, 0)
        exact = 2 * mp.pi * (1 - mp.sqrt(1 - 1 / mp.mpf(distance) ** 2)) / 8
        errors.append(relative(weight, numbers([exact])))
    return np.concatenate(errors)


@case(
    "reflection by a power of a cosine, M^a",
    "pose/phong_operator.py",
    "orders 1 to 8, exponents 0 to 1e6",
    "float64",
    0.4,
    "exact fractions, rounded once; against beta functions",
)
def power_matrix():
    from relightcli.core.pose.phong_operator import phong_matrix

    errors = []
    for a in (0.0, 0.5, 1.0, 50.0, 1e6):
        for order in range(1, 9):
            matrix, top = phong_matrix(a, order), order - 1
            for low, high, m in {(0, 0, 0), (0, top, 0), (top, top, 0), (top, top, top), (top // 2, top, top // 2)}:
                exact = _power_entry(mp.mpf(a), low, high, m)
                found = matrix[low * (low + 1) + m, high * (high + 1) + m]
                # An entry that is 0 by symmetry is held against 1.
                errors.append(relative(np.array(found), exact, exact if abs(exact) > 1e-40 else 1.0))
    return np.array(errors)


def _power_entry(a, low, high, m):
    """int_0^1 z^(a + k) (1 - z^2)^m dz is half the beta function of (a + k + 1) / 2 and m + 1."""
    product = times(powers(low, m), powers(high, m))
    size = [mp.mpf(2 * b + 1) * mp.factorial(b - m) / mp.factorial(b + m) for b in (low, high)]
    whole = mp.fsum(c * mp.beta((a + k + 1) / 2, m + 1) / 2 for k, c in enumerate(product))
    return mp.sqrt(size[0] * size[1]) / 2 * whole


@case(
    "bands of a power of a cosine",
    "pose/phong_operator.py",
    "16 bands, exponents 0 to 1e6",
    "float64",
    1.8,
    "a product of 8 ratios, none of which cancels",
)
def power_bands():
    from relightcli.core.pose.phong_operator import phong_factors

    errors = []
    for a in (0.0, 0.5, 1.0, 7.3, 1e3, 1e6):
        found = phong_factors(a, 16)
        b = mp.mpf(a) + 1
        exact = [b * mp.fsum(x / (b + k) for k, x in enumerate(powers(band))) for band in range(16)]
        vanish = np.abs(found) < 1e-30
        errors.append(relative(found, numbers(exact), np.where(vanish, 1.0, np.abs(found))))
    return np.stack(errors)


@case(
    "bands of any kernel",
    "pose/phong_operator.py",
    "powers 0 to 1e6 by quadrature, 16 bands",
    "float64",
    4.5,
    "a cosine next to 1 is rounded, the millionth power a million times as much; relative to band 0",
)
def kernel_bands():
    from relightcli.core.pose.phong_operator import kernel_factors, phong_factors

    errors = []
    for a in (0.0, 0.5, 1.0, 100.0, 1e6):

        def kernel(t, a=a):
            return np.where(t > 0.0, (a + 1) / (2 * np.pi) * np.exp(a * np.log(np.maximum(t, 1e-300))), 0.0)

        errors.append(np.abs(kernel_factors(kernel, 16) - phong_factors(a, 16)))
    return np.stack(errors)


@case(
    "zonal lobes to harmonics",
    "pose/zh_lobes.py pose/shading.py",
    "axes anywhere and within 1e-6 of the poles, order 6",
    "float32",
    1.3,
    SINGLE + "; relative to the lobe's norm",
)
def zonal():
    from relightcli.core.pose.zh_lobes import Lobes, visibility_of

    axis = np.concatenate([directions(6, 1), directions(6, 2, 1e-6)]).astype(np.float32)
    z = np.array([0.7, 0.4, 0.2, 0.1, 0.05], np.float32)
    lobes = Lobes(np.full((1, 12), 0.5, np.float32), axis[None, :, None], np.tile(z, (1, 12, 1, 1)))
    found = visibility_of(lobes)[0]
    errors = []
    for k in range(12):
        y = harmonics(mpf(axis[k]), 6)
        exact = [mp.mpf(0.5)]
        for band in range(1, 6):
            scale = mp.mpf(float(z[band - 1])) * mp.sqrt(4 * mp.pi / (2 * band + 1))
            exact += [scale * x for x in y[band * band : (band + 1) ** 2]]
        errors.append(relative(found[k], numbers(exact), float(np.linalg.norm(z))))
    return np.stack(errors)


@case(
    "axes of lobes as numbers, and back",
    "pose/lobe_parameters.py",
    "logarithms and angles; 1e-7 to pi - 1e-3 from their centre, at the poles",
    "float32",
    1.5,
    SINGLE + "; an angle near pi has a rounding of 2e-7; relative to 1",
)
def axes():
    from relightcli.core.pose.lobe_parameters import ANGLES, LOG, lobes_of, parameters_of
    from relightcli.core.pose.zh_lobes import Lobes

    errors = []
    for kind in (LOG, ANGLES):
        for away in (1e-7, 1e-4, 0.5, math.pi - 1e-3):
            center = np.array([1e-9, 0.0, 1.0]) if kind == ANGLES else directions(1, 5)[0]
            other = np.cross(center, [0.3, 1.0, 0.2])
            other /= np.linalg.norm(other)
            tilted = math.cos(away) * center + math.sin(away) * other
            axis = np.stack([center, tilted]).astype(np.float32)[:, None, None]
            # The first frame has nearly all energy, so that it is the centre.
            value = np.array([1.0, 1e-4], np.float32)[:, None, None, None] * np.ones((2, 1, 1, 3), np.float32)
            found = parameters_of(Lobes(np.ones((2, 1), np.float32), axis, value), kind)
            back = lobes_of(found.value, found.centre, kind).axis[:, 0, 0]
            want = np.stack([numbers(unit(mpf(x))) for x in axis[:, 0, 0]])
            errors.append(relative(back, want, 1.0) / max(1.0, away))
            if kind == ANGLES:
                polar = mp.atan2(mp.hypot(*mpf(axis[1, 0, 0, :2])), mp.mpf(float(axis[1, 0, 0, 2])))
                errors.append(np.full((2, 3), relative(found.value[1, 0, -2], polar)))
    return np.stack(errors)


@case(
    "quaternions: between, logarithm, matrix",
    "pose/clip.py",
    "turns of 1e-8 to 180 degrees",
    "float64",
    2.0,
    ROUNDINGS + "; logarithms relative to the angle",
)
def quaternions():
    from relightcli.core.pose.clip import rotation_matrix, rotation_vector, slerp, unit_quaternion

    errors = []
    axis = directions(1, 3)[0]
    for degrees in (1e-8, 1e-3, 10.0, 90.0, 179.9999999, 180.0):
        half = 0.5 * math.radians(degrees)
        q = unit_quaternion(np.append(axis * math.sin(half), math.cos(half)))
        x = mpf(q)
        sine = norm(x[:3])
        angle = 2 * mp.atan2(sine, x[3])
        errors.append(relative(rotation_vector(q), numbers(angle * c / sine for c in x[:3]), angle))
        none = np.array([0.0, 0.0, 0.0, 1.0])
        third = slerp(none, q, np.array([1 / 3]))
        u = mp.mpf(1 / 3) * angle / 2
        exact = [mp.sin(u) * c / sine for c in x[:3]]
        errors.append(relative(third[:3], numbers(exact), abs(mp.sin(u))))
        m = rotation_matrix(q)
        turned = [
            mp.mpf(1) - 2 * (x[1] ** 2 + x[2] ** 2),
            2 * (x[0] * x[1] - x[2] * x[3]),
            2 * (x[0] * x[2] + x[1] * x[3]),
        ]
        errors.append(relative(m[0], numbers(turned), 1.0))
    return np.stack(errors)


@case(
    "turn from one bone to another",
    "pose/retarget.py",
    "1e-9 radians, a right angle, pi - 1e-3 to pi - 1e-9",
    "float64",
    3.0,
    "1 + cos by the sum of both, not by their product; relative to 1 at turns up to pi - 1e-3, beyond over what is "
    "left to pi",
)
def bones():
    from relightcli.core.pose.clip import rotation_matrix
    from relightcli.core.pose.retarget import _nearest_rotation

    errors = []
    for away in (1e-9, 1.5, math.pi - 1e-3, math.pi - 1e-6, math.pi - 1e-9):
        one = directions(1, 6)[0]
        other = np.cross(one, [1.0, 0.2, 0.1])
        other = math.cos(away) * one + math.sin(away) * other / np.linalg.norm(other)
        q = _nearest_rotation(one[None], other[None])
        turned = rotation_matrix(q) @ one
        exact = numbers(unit(mpf(other)))
        errors.append(relative(turned, exact, 1.0 / max(min(1.0, (math.pi - away) / 1e-3), 1e-30)))
    return np.stack(errors)


@case(
    "regression on poses that are alike",
    "pose/linear_model.py",
    "features of 1 + 1e-6 noise, two of them equal",
    "float32",
    1.0,
    "normal equations in float64 of scores of unit variance; targets are float32; relative to 1",
)
def poses():
    from relightcli.core.pose.linear_model import pose_space, regress

    rng = np.random.default_rng(8)
    noise = rng.standard_normal((40, 3))
    features = 1.0 + 1e-6 * np.stack([noise[:, 0], noise[:, 1], noise[:, 0], noise[:, 2]], 1)
    space = pose_space(features)
    assert space.rank == 3
    scores = space.scores(features)
    target = (0.3 + noise @ [0.5, -0.2, 0.1]).astype(np.float32)
    model = regress(scores, space.share, target[:, None, None], 0.0)
    found = model.intercept[0, 0] + scores @ model.slope[0, 0]
    return np.abs(found - target)


@case(
    "rays of a long lens",
    "transport/camera.py",
    "fov 90 to 1e-4 degrees, an eye 1e6 away",
    "float64",
    1.0,
    "relative to the unit length",
)
def lens():
    from relightcli.core.transport.camera import film_direction, make_film
    from relightcli.scene.model import Camera

    errors = []
    for fov, far in ((90.0, 3.0), (1.0, 1e3), (1e-4, 1e6)):
        film = make_film(Camera("c", (far, 0.3 * far, 0.1), (0.0, 0.5, 0.0), (0.0, 1.0, 0.0), fov, (8, 6)))
        f = unit([-mp.mpf(far), mp.mpf(0.5) - mp.mpf(0.3 * far), -mp.mpf(0.1)])
        r = unit([-f[2], mp.mpf(0), f[0]])
        up = [r[1] * f[2] - r[2] * f[1], r[2] * f[0] - r[0] * f[2], r[0] * f[1] - r[1] * f[0]]
        half = mp.tan(mp.radians(mp.mpf(fov)) / 2)
        for x, y in ((0.0, 0.0), (3.7, 2.2), (8.0, 6.0)):
            a, b = (2 * mp.mpf(x) / 8 - 1) * half * 8 / 6, (1 - 2 * mp.mpf(y) / 6) * half
            exact = unit([f[k] + a * r[k] + b * up[k] for k in range(3)])
            errors.append(relative(np.array(film_direction(film, x, y)), numbers(exact), 1.0))
    return np.stack(errors)


@case(
    "areas of receivers",
    "transport/receivers.py",
    "sizes 1e-6 and 1e6, slivers of 1e-6, 2^20 sizes away",
    "float64",
    1.5,
    ROUNDINGS + " of differences of coordinates",
)
def areas():
    from relightcli.core.transport.receivers import receiver_areas

    errors = []
    for scale, shift in ((1e-6, 0.0), (1e6, 0.0), (1.0, 2.0**20)):
        p = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0], [0, 0, 1.0]]) * scale + shift
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        found = receiver_areas(p, faces, np.arange(4, dtype=np.int32))
        each = []
        for i, j, k in faces:
            a, b = mpf(p[j]) - mpf(p[i]), mpf(p[k]) - mpf(p[i])
            each.append(norm([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]) / 6)
        exact = [each[0] + each[1], each[0], each[0] + each[1], each[1]]
        errors.append(relative(found, numbers(exact)))
    return np.stack(errors)


@case(
    "spread of a path tracer's passes",
    "transport/path_tracer.py",
    "passes that agree to 1 to 1e-7",
    "float32",
    0.5,
    "a difference of sums of squares knows 1e-8 of the mean; the picture beside it is float32; standard error relative "
    "to the mean",
)
def spread():
    from relightcli.core.transport.path_tracer import Tile, resolve

    errors = []
    for size in (1.0, 1e-3, 1e-5, 1e-7):
        x = 3.0 + 3.0 * size * np.random.default_rng(2).standard_normal(16)
        tile = Tile(np.full((1, 1, 1, 3), x.sum()), np.full((1, 1, 3), (x * x).sum()), np.full((1, 1), 16.0), 16, 0)
        mean = mp.fsum(x.tolist()) / 16
        exact = mp.sqrt(mp.fsum((mp.mpf(v) - mean) ** 2 for v in x) / (16 * 15))
        found = np.sqrt(resolve(tile).variance.astype(np.float64))[0, 0, 0]
        errors.append(relative(np.array(found), exact, mean))
    return np.array(errors)


@case(
    "frames of receivers",
    "transport/transfer.py",
    "normals anywhere and at the poles, order 4",
    "float32",
    1.3,
    SINGLE + "; relative to 1",
)
def local():
    from relightcli.core.brdf.sampling import orthonormal_frame
    from relightcli.core.transport.transfer import local_rotations

    n = np.concatenate([directions(3, 1), directions(2, 2, 1e-4)]).astype(np.float32)
    found = local_rotations(n, 4)
    errors = []
    for normal, matrix in zip(n, found, strict=True):
        s, t = orthonormal_frame(tuple(normal.astype(np.float64)))
        for w in directions(3, 9):
            exact = numbers(harmonics(w, 4))
            inside = [dot(mpf(w), mpf(np.array(a, np.float64))) for a in (s, t, normal.astype(np.float64))]
            back = numbers(harmonics(inside, 4))
            # The same function seen in both frames: y_local(F w) = R y_world(w).
            errors.append([float(abs(x)) for x in (mpf(matrix) @ exact - back)])
    return np.array(errors)


@case(
    "even light in a receiver's frame",
    "transport/transfer.py",
    "order 8",
    "float64",
    2.5,
    "Gauss points; constants of the harmonics; relative to band 0",
)
def even():
    from relightcli.core.transport.transfer import even_projection

    found = even_projection(8)
    exact = [mp.mpf(0)] * 64
    for band in range(8):
        whole = mp.fsum(x / (k + 2) for k, x in enumerate(powers(band)))
        exact[band * (band + 1)] = 2 * mp.sqrt((2 * band + 1) / (4 * mp.pi)) * whole
    return relative(found, numbers(exact), exact[0])


@case(
    "errors of pictures",
    "measure/errors.py",
    "float32 pictures of 1e6 that differ by 1e-7 of it, 1e4 values",
    "float64",
    1.5,
    "differences of float32 are exact; sums in float64",
)
def pictures():
    from relightcli.core.measure.errors import psnr, relative_rmse, rmse

    b = (1e6 * (1 + np.random.default_rng(1).random(10000))).astype(np.float32)
    a = np.where(np.arange(10000) % 7 == 0, np.nextafter(b, np.float32(np.inf)), b)
    square = mp.fsum((mp.mpf(float(x)) - mp.mpf(float(y))) ** 2 for x, y in zip(a, b, strict=True)) / 10000
    power = mp.fsum(mp.mpf(float(y)) ** 2 for y in b) / 10000
    peak = mp.mpf(float(b.max()))
    exact = [mp.sqrt(square), mp.sqrt(square / power), 20 * mp.log10(peak / mp.sqrt(square))]
    return relative(np.array([rmse(a, b), relative_rmse(a, b), psnr(a, b)]), numbers(exact))


@case(
    "angles of a rotation, and back",
    "(scene) moving",
    "tilts of 0 to 90 degrees, 1e-9 short of it",
    "float64",
    1.5,
    "atan2, and what is left when the first turn is undone; relative to 1",
)
def euler():
    from relightcli.scene.moving import angles, rotation

    errors = []
    for y in (0.0, 30.0, 89.99, 90.0 - 1e-7, 90.0 - 1e-9, 90.0, -90.0 + 1e-8, 179.0):
        turn = rotation((12.0, y, -77.0))
        errors.append(np.abs(rotation(angles(turn)) - turn))
    return np.stack(errors)

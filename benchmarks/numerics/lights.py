"""Light: maps and their texels, skies, suns, points, local lights; and how it is summed at receivers."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.numerics.case import case, dot, mp, mpf, norm, numbers, relative, unit
from benchmarks.numerics.sphere import ROUNDINGS


@case(
    "solid angle of a map's texels", "lights/latlong.py", "1 x 1 to 8192 rows, to the poles", "float64", 1.0, ROUNDINGS
)
def texels():
    from relightcli.core.lights.latlong import texel_solid_angles

    errors = []
    for height in (1, 2, 3, 256, 8192):
        found = texel_solid_angles(height, 2 * height)
        pick = sorted({0, height // 3, height - 1})
        exact = numbers(mp.pi / height * (mp.cos(mp.pi * i / height) - mp.cos(mp.pi * (i + 1) / height)) for i in pick)
        errors.append(relative(found[pick], exact))
    return np.concatenate(errors)


@case(
    "light of one pixel on the cube",
    "lights/environment.py",
    "4096 rows, at the pole, the equator and between",
    "float32",
    1.5,
    "flux and moment of one texel, relative to its flux; pictures are float32",
)
def pixel():
    from relightcli.core.lights.environment import latlong_to_cube

    # Flat maps of few columns are as hard for the rows and cheap.
    return np.concatenate([_pixel(lambda m: latlong_to_cube(m, 8), row) for row in (0, 1, 700, 2047, 4095)])


@case(
    "light of one pixel on a quadtree's leaves",
    "lights/leaf_light.py",
    "4096 rows, 8 and 512 texels a side",
    "float32",
    1.5,
    "flux and moment of all leaves, relative to the pixel's flux; pictures are float32",
)
def leaf():
    from relightcli.core.lights.leaf_light import leaf_light
    from relightcli.core.lights.quadtree import build_tree, children, roots

    errors = []
    for resolution in (8, 512):
        leaves = roots(resolution)
        for _ in range(2):
            leaves = [part for cell in leaves for part in children(cell)]
        tree = build_tree(leaves, resolution)
        errors += [_pixel(lambda m, t=tree: leaf_light(m, t), row) for row in (0, 1, 700, 2047, 4095)]
    return np.concatenate(errors)


def _pixel(kernel, row, height=4096, width=16):
    """Totals of flux and moment of a map that is black but for one pixel."""
    radiance = np.zeros((height, width, 3), np.float32)
    radiance[row, 5] = 1e6
    sky = kernel(radiance)
    top, bottom = mp.cos(mp.pi * row / height), mp.cos(mp.pi * (row + 1) / height)
    low, high = mp.pi * (1 - mp.mpf(12) / width), mp.pi * (1 - mp.mpf(10) / width)
    flux = mp.mpf(1e6) * (high - low) * (top - bottom)

    def area(s):  # antiderivative of sqrt(1 - s^2)
        return (mp.asin(s) + s * mp.sqrt(1 - s * s)) / 2

    across = area(top) - area(bottom)
    exact = [
        flux,
        1e6 * (mp.cos(low) - mp.cos(high)) * across,
        1e6 * (high - low) * (top**2 - bottom**2) / 2,
        1e6 * (mp.sin(high) - mp.sin(low)) * across,
    ]
    found = [sky.flux[:, 0].sum(), *sky.moment[:, 0].sum(axis=0)]
    return relative(np.array(found), numbers(mp.mpf(x) for x in exact), flux)


@case(
    "mean direction of light in a texel",
    "lights/environment.py",
    "1024 rows into 64 texels a side",
    "float32",
    3.0,
    "a table of the arcus tangent, straight to 1e-8 between its entries, over a pixel's 3e-3; relative to the flux: "
    "1e-5 radians, a thousandth of a texel",
)
def moments():
    from relightcli.core.lights.environment import latlong_to_cube

    errors = []
    for row in (0, 3, 200, 511):
        radiance = np.zeros((1024, 64, 3), np.float32)
        radiance[row] = 1.0
        sky = latlong_to_cube(radiance, 64)
        lit = sky.flux[:, 0] > 1e-12
        flux, moment = sky.flux[lit, 0], sky.moment[lit, 0]
        # Every pixel of a row has one mean latitude, whatever texels it is shared by; its length says the rest.
        top, bottom = mp.cos(mp.pi * row / 1024), mp.cos(mp.pi * (row + 1) / 1024)
        errors.append(relative(np.array([moment[:, 1].sum() / flux.sum()]), numbers([(top + bottom) / 2])))
        length = np.linalg.norm(moment, axis=1) / flux
        errors.append(np.maximum(length - 1.0, 0.0))
    return np.concatenate(errors)


@case(
    "parts of a pixel as points",
    "lights/points.py",
    "8192 rows, to the poles",
    "float64",
    2.0,
    "relative to the unit length",
)
def points():
    from relightcli.core.lights.points import pixel_parts

    row, height = np.array([0, 1, 4095, 8191]), 8192
    found = pixel_parts(row, np.array([0, 7, 3, 16383]), (height, 16384), 0.3, 1).reshape(-1, 3)
    exact = []
    for r, c in zip(row.tolist(), (0, 7, 3, 16383), strict=True):
        s = (mp.cos(mp.pi * r / height) + mp.cos(mp.pi * (r + 1) / height)) / 2
        a = mp.pi * (1 - (2 * c + 1) / mp.mpf(16384)) + mp.mpf(0.3)
        k = mp.sqrt(1 - s * s)
        exact.append(numbers([mp.sin(a) * k, s, mp.cos(a) * k]))
    # Where the height is nearly 1, the root of 1 - s^2 has the rounding of s over itself.
    return relative(found, np.stack(exact), 1.0) / np.array([1e4, 1e3, 1, 1e4])[:, None]


@case(
    "angle to the sun",
    "lights/sky.py",
    "the sky's texels next to the sun, 512 rows",
    "float32",
    0.7,
    "the map is float32",
)
def sky():
    from relightcli.core.lights import sky as daylight
    from relightcli.core.lights.sun import SOLID_ANGLE, sun_radiance

    size, elevation, azimuth, turbidity = (512, 1024), 0.7, 0.4, 3.0
    found = daylight.sky_latlong(math.degrees(elevation), math.degrees(azimuth), turbidity, size).astype(np.float64)
    latitude = [mp.pi * (mp.mpf(1) / 2 - (mp.mpf(i) + 0.5) / 512) for i in range(512)]
    row = [k for k in range(512) if abs(float(latitude[k]) - elevation) < 0.05][::4]
    column = [k for k in range(1024) if abs(math.pi * (1 - (2 * k + 1) / 1024) - azimuth) < 0.05][::4]
    share = daylight.sun_shares(elevation, azimuth, size)
    sun = sun_radiance(elevation, turbidity) * SOLID_ANGLE
    h = mp.radians(mp.mpf(math.degrees(elevation)))
    a = mp.radians(mp.mpf(math.degrees(azimuth)))
    errors = []
    for i in row:
        for j in column:
            longitude = mp.pi * (1 - (2 * mp.mpf(j) + 1) / 1024)
            cosine = mp.sin(latitude[i]) * mp.sin(h) + mp.cos(latitude[i]) * mp.cos(h) * mp.cos(longitude - a)
            exact = daylight.clear_sky(
                np.array(float(mp.sin(latitude[i]))), np.array(float(mp.acos(cosine))), elevation, turbidity
            )
            texel = float(2 * mp.pi / 1024 * (mp.cos(mp.pi * i / 512) - mp.cos(mp.pi * (i + 1) / 512)))
            exact = (exact + share[i, j] / texel * sun) / daylight.UNIT
            errors.append(relative(found[i, j], mpf(exact)))
    return np.stack(errors)


@case("the sun's solid angle", "lights/sun.py", "0.53 degrees", "float64", 1.0, ROUNDINGS)
def sun():
    from relightcli.core.lights.sun import ANGULAR_RADIUS, SOLID_ANGLE

    return relative(np.array([SOLID_ANGLE]), numbers([2 * mp.pi * (1 - mp.cos(mp.mpf(ANGULAR_RADIUS)))]))


@case(
    "kernel of a prefiltered sky",
    "lights/prefiltered.py",
    "lobes of 7 to 21 degrees, to four deviations",
    "float32",
    1.5,
    "a chord of float32 directions, squared, over the variance; relative to the peak",
)
def kernel():
    from relightcli.core.lights import prefiltered
    from relightcli.core.sphere import cube

    errors = []
    for degrees in (7.0, 21.0):
        plan = prefiltered._plan(64, degrees, 1)
        center = prefiltered._by_tile(cube.texel_directions(plan.source).reshape(-1, 3), plan.source)
        peak = float(plan.weight.max())
        scale = None
        for m in (0, 17, 101):
            for p in range(plan.start[m], plan.start[m + 1], 3):
                for t in range(0, center.shape[2], 5):
                    a, b = unit(mpf(plan.node[m])), unit(mpf(center[plan.tile[p]][:, t]))
                    chord = norm([x - y for x, y in zip(a, b, strict=True)])
                    angle = 2 * mp.asin(chord / 2)
                    exact = mp.exp(-(angle**2) / (2 * mp.mpf(plan.narrow) ** 2))
                    if scale is None:
                        end = min(mp.pi, 4 * mp.mpf(plan.narrow))
                        whole = mp.quad(
                            lambda x, n=plan.narrow: mp.exp(-x * x / (2 * mp.mpf(n) ** 2)) * mp.sin(x), [0, end]
                        )
                        scale = 1 / (2 * mp.pi * whole)
                    if angle < 3.9 * plan.narrow:
                        errors.append(relative(plan.weight[p, t : t + 1], numbers([exact * scale]), peak)[0])
    return np.array(errors)


@case(
    "sky behind a hidden sun",
    "shade/irradiance.py",
    "a hidden texel of 1e6 sr beside a sky of 1e-3",
    "float32",
    1.5,
    "running sums in float64 reach 1e6 and are taken apart again: 1e-10 for each of some hundred runs, by chance of "
    "either sign, beside a sky of 3e-3",
)
def hidden_sun():
    from relightcli.core.lights.environment import SkyCube
    from relightcli.core.shade.irradiance import irradiance, moment_prefix
    from relightcli.core.sphere import cube

    d = cube.texel_directions(16).reshape(-1, 3)
    flux = 1e-3 * np.tile(cube.solid_angles(16).reshape(-1), 6)
    sun = 600
    flux[sun] = 1e6
    moment = np.repeat((d * flux[:, None])[:, None], 3, axis=1)
    bits = np.random.default_rng(1).integers(0, 256, (4, 6, 16, 2), dtype=np.uint8)
    bits.reshape(4, -1)[:, sun // 8] &= np.uint8(~(1 << (sun % 8)) & 0xFF)
    normals = d[[sun, 3, 500, 900]].astype(np.float32)
    found = irradiance(bits, normals, moment_prefix(SkyCube(16, np.repeat(flux[:, None], 3, 1), moment)))
    seen = np.unpackbits(bits.reshape(4, -1), axis=1, bitorder="little")
    errors = []
    for i in range(4):
        terms = (moment[:, 0] @ normals[i].astype(np.float64)) * seen[i]
        exact = max(mp.fsum(terms.tolist()), 0)
        errors.append(relative(found[i, :1], numbers([mp.mpf(exact)]), float(np.abs(terms).sum())))
    return np.stack(errors)


@case(
    "cone of a sphere light",
    "transport/local_lights.py",
    "from 1.0000001 to 1e9 radii away",
    "float64",
    1.9,
    "no difference of near numbers but 1 - sin^2 next to the surface, where its root counts; relative to the solid "
    "angle",
)
def cone():
    from relightcli.core.transport.local_lights import _cone_height

    errors = []
    for distance in (1.0 + 2.0**-20, 1.1, 10.0, 1e4, 1e9):
        sphere = np.array([0.0, distance, 0.0, 1.0, 1, 1, 1])
        sine = 1 / mp.mpf(distance)
        exact = 1 - mp.sqrt(1 - sine**2)
        errors.append(relative(np.array([_cone_height(sphere, (0.0, 0.0, 0.0))]), numbers([exact])))
    # 1 - sin^2 = 2e-6 keeps ten digits, its root is a thousandth of the rest.
    return np.array(errors)


@case(
    "points drawn on local lights",
    "transport/local_lights.py",
    "spheres 1.1 to 1e6 radii away, rectangles 0.1 to 1e4",
    "float64",
    2.0,
    "distances are differences of coordinates, 1 - sin^2 one of up to 0.83; relative to the distance, and to the "
    "light's density",
)
def drawn():
    from relightcli.core.transport.local_lights import pack_lights, sample_light
    from relightcli.scene.model import RectangleLight, SphereLight

    errors = []
    p = (0.0, 0.0, 0.0)
    for distance in (1.1, 10.0, 1e4, 1e6):
        lights = pack_lights([SphereLight("ball", (0.0, distance, 0.0), 1.0, (1.0, 1.0, 1.0))])
        for u1, u2 in ((0.01, 0.2), (0.5, 0.7), (0.9, 0.4)):
            d, far, _, density = sample_light(lights, p, u1, u2)
            height = 1 - mp.sqrt(1 - 1 / mp.mpf(distance) ** 2)
            errors.append(relative(np.array(density), 1 / (2 * mp.pi * height)))
            where = [mp.mpf(far) * mp.mpf(x) for x in d]
            away = norm([where[0], where[1] - mp.mpf(distance), where[2]])
            errors.append(relative(np.array(float(away - 1)), mp.mpf(0), mp.mpf(distance)))
    for distance in (0.1, 1.0, 1e4):
        lights = pack_lights(
            [RectangleLight("card", (0.3, distance, -0.1), (1.0, 0.0, 0.2), (0.1, 0.0, 0.7), (1.0, 1.0, 1.0))]
        )
        for u1, u2 in ((0.01, 0.2), (0.5, 0.7), (0.9, 0.4)):
            d, far, _, density = sample_light(lights, p, u1, u2)
            if density:
                u, v = mpf([1.0, 0.0, 0.2]), mpf([0.1, 0.0, 0.7])
                c = mpf([0.3, distance, -0.1])
                w = [c[k] + (mp.mpf(u1) - 0.5) * u[k] + (mp.mpf(u2) - 0.5) * v[k] for k in range(3)]
                n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
                errors.append(relative(np.array(density), norm(w) ** 3 / abs(dot(w, n))))
                errors.append(relative(np.array(far), norm(w)))
    return np.array(errors)

"""Sampling of local lights: directions reach the light, densities are densities, and both ways agree."""

import math

import numpy as np
import pytest
from numba import njit

from relightcli.core.transport.local_lights import meet_light, pack_lights, sample_light, total_weight
from relightcli.scene.model import RectangleLight, SphereLight

SPHERE = SphereLight("s", (1, 2, 3), 0.5, (1, 2, 3))
RECTANGLE = RectangleLight("r", (0.5, 3, 0), (1, 0.2, 0), (0.3, 0, 1), (4, 4, 4))  # u x v looks down (-y)
POINT = (0.2, 0.1, -0.3)


@njit
def draw(lights, p, u):
    d = np.empty((len(u), 3))
    t, density = np.empty(len(u)), np.empty(len(u))
    for i in range(len(u)):
        direction, t[i], _, density[i] = sample_light(lights, p, u[i, 0], u[i, 1])
        d[i, 0], d[i, 1], d[i, 2] = direction
    return d, t, density


@njit
def meet(lights, j, p, d):
    t, density = np.empty(len(d)), np.empty(len(d))
    total = total_weight(lights, p)
    for i in range(len(d)):
        t[i], _, density[i] = meet_light(lights, j, p, (d[i, 0], d[i, 1], d[i, 2]), total)
    return t, density


@pytest.mark.parametrize("light", [SPHERE, RECTANGLE], ids=["sphere", "rectangle"])
def test_samples_lie_on_the_light_and_know_their_density(light):
    lights = pack_lights([light])
    d, t, density = draw(lights, POINT, np.random.default_rng(0).random((10_000, 2)))
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-12)
    found, again = meet(lights, 0, POINT, d)
    hit = np.isfinite(found)
    # A sample on the very rim may miss by rounding.
    assert hit.mean() > 0.999
    # Near the rim the distance to a sphere goes like a root of rounding: 1e-8.
    np.testing.assert_allclose(found[hit], t[hit], rtol=1e-7)
    np.testing.assert_allclose(again[hit], density[hit], rtol=1e-9)
    if light is SPHERE:
        on = np.array(POINT) + t[:, None] * d - np.array(SPHERE.center)
        np.testing.assert_allclose(np.linalg.norm(on, axis=1), 0.5, rtol=1e-7)


def test_mixture_of_lights_is_one_density():
    # E[1/p over light j] is its solid angle, for lights that are picked by unequal chances.
    lights = pack_lights([SPHERE, RECTANGLE])
    d, _, density = draw(lights, POINT, np.random.default_rng(1).random((200_000, 2)))
    on_sphere = np.isfinite(meet(lights, 0, POINT, d)[0])
    distance2 = sum((a - b) ** 2 for a, b in zip(SPHERE.center, POINT, strict=True))
    exact = 2 * math.pi * (1 - math.sqrt(1 - 0.25 / distance2))
    weight = on_sphere / density
    assert weight.mean() == pytest.approx(exact, abs=5 * weight.std() / math.sqrt(len(weight)))
    # Where they do not overlap, each direction's density is the one of the light that it meets.
    _, q = meet(lights, 0, POINT, d[on_sphere])
    np.testing.assert_allclose(q, density[on_sphere], rtol=1e-9)


def test_solid_angle_of_the_rectangle():
    # Octahedral formula for a triangle's solid angle [Van Oosterom 1983], twice.
    lights = pack_lights([RECTANGLE])
    _, _, density = draw(lights, POINT, np.random.default_rng(2).random((200_000, 2)))
    weight = 1 / density
    c, u, v = (np.array(x, float) for x in (RECTANGLE.center, RECTANGLE.edge_u, RECTANGLE.edge_v))
    corners = [c + a * u + b * v - POINT for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]

    def triangle(a, b, c):
        a, b, c = (x / np.linalg.norm(x) for x in (a, b, c))
        return 2 * math.atan2(abs(np.dot(a, np.cross(b, c))), 1 + a @ b + b @ c + c @ a)

    exact = triangle(*corners[:3]) + triangle(corners[0], corners[2], corners[3])
    assert weight.mean() == pytest.approx(exact, abs=5 * weight.std() / math.sqrt(len(weight)))


@pytest.mark.parametrize("distance", [1.0 + 1e-9, 1.5, 1e3, 1e7])
def test_sphere_from_touching_to_far_away(distance):
    lights = pack_lights([SphereLight("s", (0, distance, 0), 1.0, (1, 1, 1))])
    d, t, density = draw(lights, (0.0, 0.0, 0.0), np.random.default_rng(3).random((1000, 2)))
    solid_angle = 2 * math.pi / distance**2 / (1 + math.sqrt(1 - 1 / distance**2))
    np.testing.assert_allclose(density, 1 / solid_angle, rtol=1e-9)
    assert (t >= distance - 1 - 1e-9 * distance).all()
    assert (t <= distance).all()
    assert np.isfinite(d).all()


@pytest.mark.parametrize("p", [(1.0, 2.0, 3.0), (1.0, 2.3, 3.0)])
def test_nothing_arrives_inside_a_sphere(p):
    lights = pack_lights([SPHERE])
    assert total_weight(lights, p) == 0
    assert not draw(lights, p, np.random.default_rng(4).random((10, 2)))[2].any()


def test_a_rectangle_sends_nothing_behind_it():
    lights = pack_lights([RECTANGLE])
    assert total_weight(lights, (0.5, 5.0, 0.0)) == 0
    assert total_weight(lights, (0.5, -5.0, 0.0)) > 0


def test_no_lights():
    lights = pack_lights([])
    assert lights.number == 0
    assert total_weight(lights, POINT) == 0

"""Light between moving objects: the white furnace, order, limits, symmetry under rotation of everything."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.fields.body import clamped_cosine
from relightcli.core.fields.bounce import CONVERGED, settle
from relightcli.core.fields.chain import incident, light_at, open_rows, passing, put_reflections
from relightcli.core.fields.entities import Entity, Surroundings, look_up, of_object
from relightcli.core.fields.interpolate import make_grid
from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import quadrature
from relightcli.core.sphere.triple_product import product
from tests.core.brdf.reflectances import random_directions
from tests.core.fields.balls import BOX, EVEN, ball, bright, covered, even_sky, put, shadow, turned

NONE = np.int32(-1)


def light(entities, points, sky, lights=None, order=4, windowed=0.0, skip=None):
    points = np.asarray(points, float)
    skip = np.full(len(points), NONE) if skip is None else skip
    if lights is not None:
        return incident(entities, points, skip, sky, lights, windowed)
    lookup = look_up(entities, points, skip)
    return light_at(lookup, open_rows(entities, lookup, order, windowed), sky)


def crowd(count, spread, seed, field=None):
    rng = np.random.default_rng(seed)
    field = ball() if field is None else field
    turns = Rotation.random(count, random_state=seed).as_matrix()
    return [put(field, rng.normal(size=3) * spread, turns[k], rng.uniform(0.3, 2.0)) for k in range(count)]


@pytest.mark.parametrize("windowed", [0.0, 1.0])
@pytest.mark.parametrize(("count", "spread"), [(1, 1.0), (7, 3.0), (7, 0.5), (20, 1.0), (5, 0.0)])
def test_white_furnace(count, spread, windowed):
    # White objects under even light: 1 everywhere, whatever is cut, overlaps or lies in the same place.
    entities = crowd(count, spread, 1)
    even = even_sky()
    held = [np.broadcast_to(even, (len(e.proxies), 3, 16)).astype(np.float32) for e in entities]
    settled = settle(entities, even, start=held)
    points = np.concatenate(
        [np.random.default_rng(2).normal(size=(60, 3)) * 4, np.zeros((1, 3)), np.full((1, 3), 99.0)]
    )
    found = [light(entities, points, even, held, windowed=windowed), *settled.lights]
    # Single precision, 8 samples x 3 proxies x 16 terms an entity: measured 4e-6.
    for values in found:
        np.testing.assert_allclose(values, np.broadcast_to(even, values.shape), atol=3e-5 * max(1, count / 7))


def test_furnace_is_reached_from_darkness():
    entities = crowd(5, 2.5, 3)
    even = even_sky()
    settled = settle(entities, even, bounces=60)
    # Geometric: the change of the last iterates says how far the limit still is.
    for values in settled.lights:
        np.testing.assert_allclose(values, np.broadcast_to(even, values.shape), atol=1e-3)
    changes = [settle(entities, even, bounces=k).change for k in (3, 6, 12)]
    assert changes[2] < changes[1] < changes[0]


@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_iterates_are_the_neumann_sum(bounces):
    # Two balls of one proxy, D and R by hand: the lights are D + R D + .. + R^bounces D.
    field = ball(albedo=0.7, proxies=1, n=4)
    entities = [put(field, (0, 0, 0)), put(field, (2.6, 0.4, 0))]
    sky = np.random.default_rng(4).normal(size=(3, 16)) + 3 * even_sky()
    where = np.concatenate([e.proxies for e in entities])

    def response(lights, sky):
        return np.concatenate(
            [light(entities, where[k : k + 1], sky, lights, skip=np.array([k], np.int32)) for k in (0, 1)]
        )

    dark = np.zeros((3, 16))
    total = part = response(None, sky)
    for _ in range(bounces):
        part = response(list(part[:, None]), dark)
        total = total + part
    found = np.concatenate(settle(entities, sky, bounces=bounces).lights)
    np.testing.assert_allclose(found, total, atol=2e-5 * np.abs(total).max())
    if bounces:
        assert np.abs(part).max() > 1e-3 * np.abs(total).max()  # 50 times what is allowed


def test_convergence_does_not_depend_on_the_start():
    entities = crowd(4, 2.0, 5, ball(albedo=0.8))
    sky = np.random.default_rng(6).normal(size=(3, 16)) * 0.3 + even_sky()
    cold = settle(entities, sky)
    warm = settle(entities, sky, start=cold.lights)
    assert warm.bounces < cold.bounces
    for a, b in zip(cold.lights, warm.lights, strict=True):
        np.testing.assert_allclose(a, b, atol=10 * CONVERGED * np.abs(a).max())


def test_rotating_everything_rotates_the_light():
    entities = crowd(4, 2.0, 7, ball(albedo=0.8))
    sky = np.random.default_rng(8).normal(size=(3, 16)) * 0.3 + even_sky()
    points = random_directions(20, 9) * 5
    r = Rotation.random(random_state=10).as_matrix()
    moved = [Entity(e.own, r @ e.rotation, r @ e.translation, e.scale) for e in entities]
    a = light(entities, points, sky, settle(entities, sky).lights)
    b = light(moved, points @ r.T, turned(sky, r), settle(moved, turned(sky, r)).lights)
    np.testing.assert_allclose(b, turned(a, r), atol=2e-5 * np.abs(a).max())


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_scale_is_no_matter(scale):
    entities = crowd(3, 2.0, 11, ball(albedo=0.8))
    sky = even_sky()
    points = random_directions(20, 12) * 4
    scaled = [Entity(e.own, e.rotation, e.translation * scale, e.scale * scale) for e in entities]
    a = light(entities, points, sky, settle(entities, sky).lights)
    b = light(scaled, points * scale, sky, settle(scaled, sky).lights)
    np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(a).max())


def wall_and_ball():
    """A wall of 10 x 10 in the plane z = 0 whose centre is 5 from the point; a bright ball of radius 1 behind it."""
    whole = np.zeros((6 * 4, 16), np.float32)
    d, w = quadrature(40)
    whole[:] = (w * (d[:, 2] > 0)) @ sh.harmonics(d, 4)  # nothing passes from below, as seen close to the wall
    grid = make_grid(np.array([4.0]), 2)
    box = np.array([[-5.0, -5, -0.01], [5, 5, 0]])
    wall = Surroundings(grid, np.zeros(3), box, 7.1, occlusion=whole)
    q = np.array([[4.0, 3.0, 0.1]])  # the shell lies in front: the wall's field holds within it
    return [Entity(wall, np.eye(3), np.zeros(3)), put(bright(), q[0] - [0, 0, 2.0 + 0.1])], q


def test_no_light_through_a_wall():
    entities, q = wall_and_ball()
    # Moved so that q is within the wall's shell: the field of a large wall is the same all along it.
    entities[0] = Entity(entities[0].own, np.eye(3), q[0] - [3.9, 0, 0.1])
    lookup = look_up(entities, q, np.full(1, NONE))
    assert lookup.nearest[0].tolist() == [0, 1]
    centres = [np.linalg.norm(q[0] - e.translation) for e in entities]
    assert centres[1] < centres[0]  # by centres the ball would come first
    rows = open_rows(entities, lookup, 4)
    found = light_at(lookup, rows, np.zeros((3, 16)))[0, 0]
    bare = light(entities[1:], q, np.zeros((3, 16)))[0, 0]
    assert bare[0] > 0.2
    # What is cut lets a little through, as of one hemisphere times the other at order 4: 10 % of the ball's light. The
    # wrong order lets all of it through.
    assert abs(found[0]) < 0.12 * bare[0]
    wrong = light_at(lookup._replace(nearest=lookup.nearest[:, ::-1].copy()), rows, np.zeros((3, 16)))[0, 0]
    np.testing.assert_allclose(wrong, bare, atol=1e-6)


@pytest.mark.parametrize("height", [1.3, 2.0, 3.7, 9.0])
@pytest.mark.parametrize("cosine", [1.0, 0.8])
def test_plane_lit_by_a_bright_ball(height, cosine):
    # E = pi B cos / H^2 where the ball clears the horizon.
    if height * cosine < 1:
        pytest.skip("the ball dips below the horizon")
    radius = 0.7
    to_ball = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    entities = [put(bright(order=8, n=16, shells=32), to_ball * height * radius, scale=radius)]
    found = light(entities, np.zeros((1, 3)), np.zeros((3, 64)), order=8)[0, 0]
    e = found @ (clamped_cosine(8) * sh.harmonics(np.array([0.0, 0, 1]), 8))
    # Order 8 holds all of the cosine's light but 0.5 %; 32 shells and 16^2 texels between samples. Beyond the last
    # shell, at 8, all bands fall alike while those of the ball become those of a point: 2 %.
    assert e == pytest.approx(np.pi * cosine / height**2, rel=1e-2 if height < 8 else 2e-2)


def test_occlusion_is_the_closed_form_between_samples():
    entities = [put(shadow(16, 16))]
    d = np.random.default_rng(13).uniform(1.02, 8, 300)
    points = random_directions(300, 14) * d[:, None]
    lookup = look_up(entities, points, np.full(300, NONE))
    found = passing(lookup, open_rows(entities, lookup, 4))
    expected = EVEN * (np.arange(16) == 0) - covered(points, 4)
    error = np.linalg.norm(found - expected, axis=1) / EVEN
    # Largest close to contact, where the cap's edge moves as the root of the distance: measured 4.2 %.
    assert error.max() < 0.05
    assert error.mean() < 0.01


def test_fifty_occluders_in_a_row():
    field = ball(albedo=0.5)
    entities = [put(field, (0, 0, 2.0 + 0.5 * k)) for k in range(50)]
    points = np.concatenate([random_directions(30, 15), np.zeros((1, 3)), [[0, 0, -3.0], [0, 0, 14.25], [5, 5, 14]]])
    lookup = look_up(entities, points, np.full(len(points), NONE))
    y = sh.harmonics(quadrature(20)[0], 4)
    smooth = passing(lookup, open_rows(entities, lookup, 4, 1.0))
    assert np.isfinite(smooth).all()
    # A product with a function in [0, 1] shrinks: none of 50 can make the norm grow (1e-4 for single precision).
    assert (np.linalg.norm(smooth, axis=1) <= EVEN * (1 + 1e-4)).all()
    assert smooth[:, 0].min() > 0
    plain = passing(lookup, open_rows(entities, lookup, 4, 0.0))
    assert np.linalg.norm(plain, axis=1).max() < 1.5 * EVEN
    # Windowed values ring less than the plain ones do.
    assert (smooth @ y.T).min() > (plain @ y.T).min()
    assert (smooth @ y.T).max() < 1.2


def test_chain_is_the_products_one_by_one():
    entities = crowd(3, 3.0, 16, ball(albedo=0.6))
    sky = np.random.default_rng(17).normal(size=(3, 16))
    lights = [np.random.default_rng(18).normal(size=(len(e.proxies), 3, 16)).astype(np.float32) for e in entities]
    points = random_directions(37, 19) * 6  # not a multiple of what is done at a time
    lookup = look_up(entities, points, np.full(37, NONE))
    rows = open_rows(entities, lookup, 4)
    put_reflections(rows, entities, lookup, lights)
    expected = np.broadcast_to(sky, (37, 3, 16)).copy()
    for p in range(37):
        for e in lookup.nearest[p, ::-1]:
            w = lookup.weight[p, e].astype(float)
            own = np.tensordot(w, rows[lookup.place[p, e]].astype(float), 1)
            own[0, 0] += (1 - w.sum()) * EVEN
            expected[p] = own[1:] + product(own[0], expected[p])
    np.testing.assert_allclose(light_at(lookup, rows, sky), expected, atol=1e-5 * np.abs(expected).max())
    many = look_up(entities, np.tile(points, (80, 1)), np.full(37 * 80, NONE), threads=3)  # enough to be split
    np.testing.assert_array_equal(
        light_at(many, rows, sky, threads=3), np.tile(light_at(lookup, rows, sky), (80, 1, 1))
    )


def test_black_objects_and_far_objects_reflect_nothing():
    black = crowd(3, 2.0, 20, ball(albedo=0.0))
    sky = even_sky()
    one, many = settle(black, sky, bounces=0).lights, settle(black, sky, bounces=5).lights
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a, b)
    apart = [put(ball(), (0, 0, 0)), put(ball(), (1e5, 0, 0))]
    for values in settle(apart, sky).lights:
        np.testing.assert_allclose(values, np.broadcast_to(sky, values.shape), atol=1e-6)


def test_points_anywhere_are_finite():
    field = ball()
    entities = [put(field), put(field), put(field, (0.5, 0, 0)), put(field, (2, 0, 0)), put(bright(n=4), (0, 0, 0))]
    points = np.array([[0, 0, 0], [0.3, 0, 0], [1, 0, 0], [1.02, 0, 0], [8, 0, 0], [8.0001, 0, 0], [1e9, 0, 0]])
    points = np.concatenate([points, *(e.proxies for e in entities)])
    found = light(entities, points, even_sky(), settle(entities, even_sky()).lights)
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 10


def test_invalid_everywhere_is_empty_space():
    field = ball(albedo=0.5)
    hollow = type(field)(**{**field.__dict__, "valid": np.zeros_like(field.valid)})
    found = light([Entity(of_object(hollow, BOX), np.eye(3), np.zeros(3))], [[0.1, 0, 0]], even_sky())
    np.testing.assert_allclose(found[0], even_sky(), atol=1e-6)

"""What stands as moving things see it, and what it loses to them: closed forms and exact sums."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import make_body
from relightcli.core.fields.chain import EVEN, open_rows
from relightcli.core.fields.close import add_samples, covered, look_close
from relightcli.core.fields.dimmed import dim, may_block, sky_basis, sky_terms
from relightcli.core.fields.entities import Entity, Surroundings, look_up
from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.interpolate import make_grid
from relightcli.core.fields.standing import (
    CELLS,
    light_from_sky,
    light_from_surfaces,
    look_around,
    sky_cells,
    unhidden,
)
from relightcli.core.lights.environment import latlong_to_cube
from relightcli.core.shade.gather import Gather
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.core.sphere import cube, sh
from relightcli.scene.model import Material

ORDER = 4
SKY = latlong_to_cube(np.random.default_rng(0).random((8, 16, 3)).astype(np.float32), 16)


def views_of(mesh, sites, outwards=True):
    """Views of a mesh whose vertices are receivers on one side."""
    positions, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    side, none = np.arange(len(positions), dtype=np.int32), np.full(len(positions), -1, np.int32)
    front, back = (side, none) if outwards else (none, side)
    return look_around(Tracer(positions, faces), positions, faces, front, back, np.asarray(sites, np.float64))


def wall(x):
    return trimesh.Trimesh([[x, -50, -50], [x, 50, -50], [x, 50, 50], [x, -50, 50]], [[0, 1, 2], [0, 2, 3]])


def test_an_open_sky_arrives_whole():
    views = views_of(wall(1e6), np.zeros((2, 3)))
    views.distance[:] = np.inf
    found = light_from_sky(views, sky_cells(SKY, ORDER))
    wanted = sh.project_sky(SKY.flux, SKY.resolution, ORDER).T
    np.testing.assert_allclose(found, np.stack([wanted, wanted]), atol=1e-6 * wanted.max())


def test_a_bright_room_is_even_light_and_hides_the_sky():
    room = trimesh.creation.box((2, 4, 6)).subdivide()
    views = views_of(room, [[0, 0, 0], [0.5, 1, -2]], outwards=False)
    exits = np.tile(np.float32([1, 2, 3]), (len(room.vertices), 1))
    found = light_from_surfaces(views, exits, ORDER, np.zeros(len(exits), bool))
    # y_i summed over cells of 11 degrees: orthogonal to 1 to 2e-3 at order 4.
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    np.testing.assert_allclose(found[0][:, 0], EVEN * np.array([1, 2, 3]), rtol=1e-6)
    assert np.abs(found[0][:, 1:]).max() < 2e-3 * 3 * EVEN
    assert not light_from_sky(views, sky_cells(SKY, ORDER)).any()


def test_other_sides_send_nothing_and_covered_corners_are_left_out():
    room = trimesh.creation.box((2, 4, 6)).subdivide()
    exits = np.ones((len(room.vertices), 3), np.float32)
    clear = np.zeros(len(exits), bool)
    assert not light_from_surfaces(views_of(room, [[0, 0, 0]]), exits, ORDER, clear).any()
    dark = np.zeros(len(exits), bool)
    dark[np.arange(0, len(exits), 5)] = True
    exits[dark] = 0.0
    views = views_of(room, [[0, 0, 0]], outwards=False)
    found = light_from_surfaces(views, exits, ORDER, dark)
    np.testing.assert_allclose(found[0][:, 0], EVEN, rtol=1e-6)


@pytest.mark.parametrize(("x", "wanted"), [(1.0, 0.0), (3.5, 1.0), (-1.0, 1.0)])
def test_a_wall_hides_what_is_behind_it(x, wanted):
    sites = np.zeros((1, 3))
    views = views_of(wall(x), sites)
    for radius in (0.01, 0.5):
        assert unhidden(views, sites, np.array([[3.0, 0.0, 0.0]]), np.array([radius]))[0, 0] == wanted


def test_half_a_wall_hides_half():
    half = trimesh.Trimesh([[1, 0, -50], [1, 50, -50], [1, 50, 50], [1, 0, 50]], [[0, 1, 2], [0, 2, 3]])
    sites = np.zeros((1, 3))
    found = unhidden(views_of(half, sites), sites, np.array([[3.0, 0.0, 0.0]]), np.array([1.5]))
    assert found[0, 0] == pytest.approx(0.5, abs=0.01)


def test_sky_terms_hold_the_irradiance():
    rng = np.random.default_rng(2)
    normals = rng.standard_normal((30, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    directions = cube.texel_directions(16).reshape(-1, 3)
    seen = (normals @ directions.T > 0) & (rng.random((30, len(directions))) < 0.7)
    bits = np.packbits(seen, axis=1, bitorder="little").reshape(30, 6, 16, 2)
    terms = sky_terms(bits, normals, sky_basis(SKY, ORDER))
    np.testing.assert_allclose(terms[..., 0] * EVEN, irradiance(bits, normals, moment_prefix(SKY)), rtol=1e-5)
    # A function of the order, times light, cosine and visibility, summed texel by texel.
    v = rng.standard_normal(ORDER**2)
    passed = sh.harmonics(directions, ORDER) @ v
    wanted = np.einsum("nt,tcx,nx,t->nc", seen, SKY.moment, normals, passed)
    np.testing.assert_allclose(terms @ v, wanted, atol=1e-5 * np.abs(wanted).max())


def test_only_what_is_behind_is_dimmed():
    cells = 8
    directions = cube.texel_directions(cells).reshape(-1, 3)
    towards = int(cube.texel_index(np.array([1.0, 0.05, 0.05]), cells))
    positions = np.array([[0.0, 0, 0], 2.0 * directions[towards]])
    one = np.ones(1, np.float32)
    solid = np.full(1, cube.solid_angles(cells)[4, 4], np.float32)
    gather = Gather(cells, np.array([0, 1]), np.array([1], np.int32), np.array([towards], np.int16), one, solid)
    hidden = np.zeros((1, 2, ORDER**2), np.float32)
    hidden[0, :, 0] = (0.25 * EVEN, 0.5 * EVEN)
    centers = np.array([[1.0, 0, 0], [4.0, 0, 0]])
    found, share = dim(gather, positions, hidden, centers, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found.cosine, 0.75, rtol=1e-5)
    np.testing.assert_allclose(found.solid_angle, 0.75 * solid, rtol=1e-5)
    assert share[0, 0] == 1.0
    assert share[0, 1] < 0.8  # one of the cells about its centre is blocked before it
    nothing, _ = dim(gather, positions, 8.0 * hidden, centers, np.array([0.1, 0.1]))
    assert nothing.cosine[0] == 0.0


def test_what_may_come_between():
    points = np.array([[0.0, 0, 0], [0, 5, 0], [10, 0, 0], [-3, 0, 0]])
    light = np.array([6.0, 0, 0])
    found = may_block(points, light, 0.5, np.array([2.0, 0.9, 0]), 0.5)
    np.testing.assert_array_equal(found, [True, False, False, True])


def test_points_close_to_a_ball_see_its_solid_angle():
    """From 1.01 radii the ball fills 2 pi (1 - cos), cos = sqrt(1 - 1 / 1.01^2): by rays from there, not by shells."""
    mesh = trimesh.creation.icosphere(4)
    positions, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    white = np.ones((len(positions), 3), np.float32)
    material = Material("white", diffuse=(1.0, 1.0, 1.0))
    normals = np.asarray(mesh.vertex_normals, np.float32)
    body = make_body(positions, normals, faces, False, white, material, ORDER)
    radii = shell_radii(body.radius, 2)
    open_ = np.zeros((2 * 6 * CELLS * CELLS, ORDER**2), np.float32)
    own = Surroundings(make_grid(radii, CELLS), body.center, np.stack([-np.ones(3), np.ones(3)]), 1.0, open_)
    entity = Entity(own, np.eye(3), np.array([0.0, 3, 0]), 0.5)
    points = np.array([[0.0, 3 - 0.505, 0], [0, 0, 0], [0, 3 - 0.503, 0]])
    lookup = look_up([entity], points, np.full(3, -1, np.int32))
    rows = open_rows([entity], lookup, ORDER)
    close = look_close(entity, 0, body, Tracer(positions, faces), points, lookup)
    np.testing.assert_array_equal(close.target, [0, 2])
    before = lookup.weight[1].copy()
    more, (where,) = add_samples(lookup, rows, [close], [entity.turn(ORDER)])
    wanted = 2 * np.pi * (1 - np.sqrt(1 - 1 / 1.01**2))
    assert (EVEN - more[lookup.place[0, 0, 0], 0, 0]) * EVEN == pytest.approx(wanted, rel=0.03)  # 512 rays of a lattice
    assert where.stop - where.start == 2
    np.testing.assert_array_equal(lookup.weight[1], before)
    up = np.tile(np.float32([0, 1, 0]), (2, 1))
    np.testing.assert_array_equal(covered(close, up, entity.rotation), [True, True])
    np.testing.assert_array_equal(covered(close, -up, entity.rotation), [False, False])

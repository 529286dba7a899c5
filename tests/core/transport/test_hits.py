"""Hits: the receivers behind the blocked part of the sky."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.adapters.rays import Tracer
from relightcli.core.sphere import cube
from relightcli.core.transport.hits import Surfaces, trace_hits
from relightcli.core.transport.visibility import trace_visibility

R, C = 32, 8
UP = np.array([[0.0, 1.0, 0.0]], np.float32)
ORIGIN = np.zeros((1, 3))


def plate(two_sided=False, facing_down=True, normal=None, height=1.0, half=0.5):
    """A triangle pair above the origin, four vertices, each with a receiver in front, and behind if two-sided."""
    positions = np.array([[-half, height, half], [half, height, half], [half, height, -half], [-half, height, -half]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    if facing_down:
        faces = faces[:, ::-1].copy()
    if normal is None:
        normal = (0, -1, 0) if facing_down else (0, 1, 0)
    normals = np.tile(np.array(normal, np.float32), (4, 1))
    front = np.arange(4, dtype=np.int32)
    back = np.arange(4, 8, dtype=np.int32) if two_sided else np.full(4, -1, np.int32)
    return Surfaces(positions, normals, faces, np.full(2, two_sided), front, back, np.zeros(8, bool))


def seen(surfaces, positions=ORIGIN, normals=UP, first=0, seed=0, cells=C):
    tracer = Tracer(surfaces.positions, surfaces.faces)
    bits = trace_visibility(tracer, positions, normals, R, 1, 0).bits
    hits, rays = trace_hits(tracer, surfaces, positions, normals, bits, cells, first, seed)
    return hits, rays, bits


def blocked_cells(bits, normals):
    """Cells with a texel that is above the horizon and not visible, by counting."""
    directions = cube.texel_directions(R).reshape(-1, 3).astype(np.float32)
    above = (normals @ directions.T > 0).reshape(-1, 6, R, R)
    open_ = np.unpackbits(bits, axis=3, bitorder="little").astype(bool)
    side = R // C
    return (above & ~open_).reshape(-1, 6, C, side, C, side).any(axis=(3, 5))


def test_every_blocked_cell_has_one_ray_and_one_receiver():
    hits, rays, bits = seen(plate())
    blocked = blocked_cells(bits, UP)
    assert blocked.sum() == rays == 16  # the plate spans a quarter of the +Y face, 4 x 4 of 8 x 8 cells
    np.testing.assert_array_equal(hits > 0, blocked)
    assert set(np.unique(hits)) == {0, 1, 2, 3, 4}


def test_the_nearest_corner_is_the_likeliest():
    # Rays of the quarter under corner 0 (x < 0, z > 0) pick it with its barycentric weight: on average more than half
    # of the others' together. The plate is much larger than a cell's footprint.
    hits, _, _ = seen(plate(half=1.0), cells=R)
    directions = cube.texel_directions(R)
    corner = directions[2, :, :, [0, 2]]  # (2, R, R): x and z on the +Y face
    for k, (x, z) in enumerate(((-1, 1), (1, 1), (1, -1), (-1, -1))):
        quarter = (corner[0] * x > 0.3) & (corner[1] * z > 0.3)
        found = hits[0, 2][quarter]
        assert (found == k + 1).mean() > 0.5


def test_corners_are_drawn_with_barycentric_weights():
    # Interpolating any linear function from the drawn corners gives its mean over the plate: here x and z, mean 0.
    # 1,500 rays, each with a spread of at most 1: standard error 0.026; four of them.
    surfaces = plate()
    positions = np.array([[x, 0.0, z] for x in (-0.2, 0.0, 0.2) for z in (-0.2, 0.0, 0.2)])
    hits, rays, _ = seen(surfaces, positions, np.repeat(UP, 9, 0), cells=R)
    directions = cube.texel_directions(R)
    true = np.zeros(3)
    drawn = np.zeros(3)
    for i in range(9):
        where = hits[i] > 0
        d = directions[where]
        true += (positions[i] + d / d[:, 1:2]).sum(axis=0)
        drawn += surfaces.positions[hits[i][where] - 1].sum(axis=0)
    np.testing.assert_allclose(drawn / rays, true / rays, atol=4 / np.sqrt(rays))
    assert rays > 1000


@pytest.mark.parametrize(
    ("surfaces", "expected"),
    [
        (plate(facing_down=False), {0}),
        (plate(facing_down=False, two_sided=True), {5, 6, 7, 8}),
        (plate(normal=(0, 1, 0)), {0}),
    ],
    ids=["back", "back of two-sided", "shading normal looks away"],
)
def test_what_sends_nothing(surfaces, expected):
    hits, rays, bits = seen(surfaces)
    blocked = blocked_cells(bits, UP)
    assert rays == blocked.sum()
    assert set(np.unique(hits[blocked])) == expected


def test_the_result_does_not_depend_on_blocks():
    rng = np.random.default_rng(1)
    positions = rng.uniform(-0.4, 0.4, (600, 3)) * [1, 0, 1]
    normals = np.repeat(UP, 600, 0)
    surfaces = plate()
    whole, rays, _ = seen(surfaces, positions, normals)
    parts = [seen(surfaces, positions[a:b], normals[a:b], first=a) for a, b in ((0, 100), (100, 411), (411, 600))]
    np.testing.assert_array_equal(whole, np.concatenate([p[0] for p in parts]))
    assert rays == sum(p[1] for p in parts)
    other, _, _ = seen(surfaces, positions, normals, seed=1)
    assert (other != whole).any()

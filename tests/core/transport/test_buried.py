"""Receivers that cannot stand on their vertex: on the line where surfaces meet, under a thing, inside one."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.adapters.rays import Tracer
from relightcli.core.shade.primary import face_normals
from relightcli.core.transport.buried import unbury
from relightcli.core.transport.receivers import vertex_receivers
from relightcli.core.transport.visibility import trace_visibility


def grid(corner, u, v, cells):
    """Positions and faces of a parallelogram that looks along u x v."""
    t = np.linspace(0, 1, cells + 1)
    p = (np.array(corner) + t[:, None, None] * np.array(u) + t[None, :, None] * np.array(v)).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    a = (i * (cells + 1) + j).reshape(-1)
    b, c, d = a + cells + 1, a + cells + 2, a + 1
    return p, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def box(low, high, cells=2):
    """A closed box, fronts outwards."""
    (x, y, z), (X, Y, Z) = low, high
    w, h, d = X - x, Y - y, Z - z
    return [
        grid((x, y, Z), (w, 0, 0), (0, h, 0), cells),
        grid((X, y, z), (-w, 0, 0), (0, h, 0), cells),
        grid((X, y, Z), (0, 0, -d), (0, h, 0), cells),
        grid((x, y, z), (0, 0, d), (0, h, 0), cells),
        grid((x, Y, Z), (w, 0, 0), (0, 0, -d), cells),
        grid((x, y, z), (w, 0, 0), (0, 0, d), cells),
    ]


def settle(parts, two_sided=False, scale=1.0):
    """(receivers where they stand, buried, positions of their vertices, tracer) of joined grids."""
    start = np.cumsum([0] + [len(p) for p, _ in parts])
    positions = np.concatenate([p for p, _ in parts]) * scale
    faces = np.concatenate([f + s for (_, f), s in zip(parts, start[:-1], strict=True)]).astype(np.int32)
    flat = face_normals(positions, faces)
    normals = np.zeros((len(positions), 3), np.float32)
    for k in range(3):
        normals[faces[:, k]] = flat
    objects = np.zeros(len(positions), np.int32)
    receivers = vertex_receivers(positions, normals, faces, objects, np.array([False]))
    tracer = Tracer(positions, faces)
    settled, buried = unbury(tracer, receivers, positions, faces, flat, np.full(len(faces), two_sided))
    return settled, buried, positions[receivers.vertex], tracer


FLOOR = grid((-1, 0, 1), (2, 0, 0), (0, 0, -2), 20)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_where_a_wall_stands_on_a_floor(scale):
    # Of the sky of a floor's vertex at the wall's foot half is free.
    wall = grid((-1, 0, 1), (0, 0, -2), (0, 1, 0), 10)
    settled, buried, vertices, tracer = settle([FLOOR, wall], scale=scale)
    assert not buried.any()
    moved = np.linalg.norm(settled.position - vertices, axis=1) / scale
    foot = (np.abs(vertices[:, 0] / scale + 1) < 1e-9) & (settled.normal[:, 1] > 0.5)
    assert foot.sum() == 21
    assert (moved[foot] > 0).all()
    # A sixty-fourth of the way across a face; the wall's are 0.2 by 0.1.
    assert moved.max() < np.hypot(0.2, 0.05) / 64 + 1e-9
    bits = trace_visibility(tracer, settled.position[foot], settled.normal[foot], 32, 1, 0).bits
    free = np.unpackbits(bits).sum() / foot.sum() / (3 * 32**2)
    inner = np.abs(vertices[foot][:, 2] / scale) < 0.9
    assert inner.any()
    # The wall is as high as the floor's half: over its edge there is more than half of the sky to see.
    assert 0.5 < free < 0.75


def test_on_a_smooth_or_open_surface_receivers_stay_on_their_vertices():
    settled, buried, vertices, _ = settle([FLOOR])
    np.testing.assert_array_equal(settled.position, vertices)
    assert not buried.any()


def test_under_a_box_receivers_go_to_its_edge():
    # A box of 0.5 x 0.5 stands on the floor: 25 of the floor's vertices are in it, its own feet touch the floor.
    settled, buried, vertices, _ = settle([FLOOR, *box((-0.26, 0.0, -0.26), (0.26, 0.6, 0.26))])
    floor = np.isclose(vertices[:, 1], 0) & (settled.normal[:, 1] > 0.5)
    inside = floor & (np.abs(vertices[:, [0, 2]]) < 0.26).all(axis=1)
    assert inside.sum() == 25
    rim = inside & (np.abs(vertices[:, [0, 2]]).max(axis=1) > 0.15)
    assert not buried[rim].any()
    # Just outside: within one step of the walk along a face.
    out = np.abs(settled.position[rim][:, [0, 2]]).max(axis=1)
    assert (out > 0.26).all()
    assert out.max() < 0.26 + 0.25 * 0.1
    assert buried[inside & ~rim].all()  # no way out along their own faces
    assert not buried[floor & ~inside].any()


def test_inside_a_two_sided_box_is_a_room():
    # Its walls are lit inside: only what is closer than the neighbours would bury a receiver.
    settled, buried, vertices, _ = settle([FLOOR, *box((-0.26, 0.0, -0.26), (0.26, 0.6, 0.26))], two_sided=True)
    middle = (np.abs(vertices) < 0.05).all(axis=1) & (settled.normal[:, 1] > 0.5)
    assert middle.any()
    assert not buried[middle].any()


def test_a_narrow_gap_is_buried():
    # A plate a hundredth of a cell above the floor.
    plate = grid((-0.5, 0.001, -0.5), (1, 0, 0), (0, 0, 1), 10)
    _, buried, vertices, _ = settle([FLOOR, plate])
    under = (vertices[:, 1] == 0) & (np.abs(vertices[:, [0, 2]]).max(axis=1) < 0.35)
    assert under.sum() == 49
    assert buried[under].all()
    outside = (vertices[:, 1] == 0) & (np.abs(vertices[:, [0, 2]]).max(axis=1) > 0.55)
    assert not buried[outside].any()


def test_the_corner_of_a_room_is_not():
    # Closed all round, fronts inwards: no ray leaves, none ends on a back, and from the corners most end close by.
    room = [(p, f[:, ::-1]) for p, f in box((-1, 0, -1), (1, 2, 1), 10)]
    _, buried, _, _ = settle(room)
    assert not buried.any()

"""Gathered light: form factors, the bowl, linearity, reciprocity; lobes against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.adapters.rays import Tracer
from relightcli.core.brdf.models import lobes, pack_materials, widen
from relightcli.core.brdf.separable import LEAST_WIDTH, TERMS
from relightcli.core.shade.bounces import Exit, bounce
from relightcli.core.shade.gather import build_gather, join
from relightcli.core.shade.lobe_factors import lobe_factors, lobe_rows
from relightcli.core.sphere import cube
from relightcli.core.transport.hits import Surfaces, trace_hits
from relightcli.core.transport.receivers import receivers_of_vertices, vertex_receivers
from relightcli.core.transport.visibility import trace_visibility
from relightcli.scene.model import Material
from tests.core.transport.scenes import sphere_grid
from tests.core.transport.test_buried import grid

R, C = 64, 16
WHITE = Material("m", diffuse=(1.0, 1.0, 1.0))


class Stage:
    """A mesh with its receivers, its gather, and one material."""

    def __init__(self, positions, normals, faces, material=WHITE, cells=C):
        n = len(positions)
        self.receivers = vertex_receivers(positions, normals, faces, np.zeros(n, np.int32), np.array([False]))
        self.front, back = receivers_of_vertices(self.receivers.vertex, self.receivers.side, n)
        tracer = Tracer(positions, faces)
        p, q = self.receivers.position, self.receivers.normal
        self.bits = trace_visibility(tracer, p, q, R, 1, 0).bits
        surfaces = Surfaces(positions, normals, faces, np.zeros(len(faces), bool), self.front, back, np.zeros(n, bool))
        self.hits, _ = trace_hits(tracer, surfaces, p, q, self.bits, cells, 0, 0)
        self.gather = build_gather(self.hits, self.bits, q, threads=2)
        self.material = np.zeros(n, np.int32)
        self.table = widen(pack_materials([material]), 0.5 * np.pi / cells)
        self.factors = lobe_factors(self.table)
        self.row = lobe_rows(self.material, self.factors)

    def exit(self, diffuse):
        lobe = np.zeros((int(self.row.max()) + 1, 6, TERMS), np.float32)
        return Exit(np.broadcast_to(np.asarray(diffuse, np.float32), (len(self.row), 3)).copy(), lobe, self.row)

    def bounce(self, light, view=None, active=None, go_on=False):
        active = np.ones(len(self.row), bool) if active is None else active
        q = self.receivers.normal
        return bounce(self.gather, light, q, self.material, self.table, self.factors, view, active, go_on, threads=2)


def joined(parts):
    start = np.cumsum([0] + [len(p) for p, _, _ in parts])
    return (
        np.concatenate([p for p, _, _ in parts]),
        np.concatenate([np.tile(np.array(n, np.float32), (len(p), 1)) for p, _, n in parts]),
        np.concatenate([f + s for (_, f, _), s in zip(parts, start[:-1], strict=True)]).astype(np.int32),
    )


def facing_squares(distance, cells=12):
    low = grid((0, 0, 1), (1, 0, 0), (0, 0, -1), cells)
    high = grid((0, distance, 0), (1, 0, 0), (0, 0, 1), cells)
    return joined([(*low, (0, 1, 0)), (*high, (0, -1, 0))])


def vertex_areas(cells):
    """Share of a unit square of cells x cells that each vertex stands for, (V,)."""
    w = np.ones(cells + 1)
    w[[0, -1]] = 0.5
    return np.outer(w, w).reshape(-1) / cells**2


@pytest.mark.parametrize(("distance", "factor"), [(0.5, 0.415253), (1.0, 0.199825), (2.0, 0.068590)])
def test_form_factor_of_facing_squares(distance, factor):
    # KT6. Radiance 1 on one square gives pi F on average on the other. Trapezoid over 12 cells: 0.2 %; rays: 0.5 %.
    positions, normals, faces = facing_squares(distance)
    stage = Stage(positions, normals, faces)
    half = len(positions) // 2
    light = stage.exit(0.0)
    light.diffuse[stage.front[half:]] = 1.0
    e, _, _ = stage.bounce(light)
    mean = (e[stage.front[:half], 0] * vertex_areas(12)).sum() / np.pi
    assert mean == pytest.approx(factor, rel=1e-2)
    assert not e[stage.front[half:]].any()  # nothing sees itself


def test_reciprocity():
    # A_1 F_12 of two patches is A_2 F_21: sources on part of one square, receivers on part of the other, and back.
    positions, normals, faces = facing_squares(0.7)
    stage = Stage(positions, normals, faces)
    half = len(positions) // 2
    area = vertex_areas(12)
    rng = np.random.default_rng(4)
    for _ in range(3):
        a, b = rng.random(half) * area, rng.random(half) * area
        light = stage.exit(0.0)
        light.diffuse[stage.front[half:]] = (b / area)[:, None]
        there = (stage.bounce(light)[0][stage.front[:half], 0] * a).sum()
        light = stage.exit(0.0)
        light.diffuse[stage.front[:half]] = (a / area)[:, None]
        back = (stage.bounce(light)[0][stage.front[half:], 0] * b).sum()
        # Monte Carlo over 2 x 169 x 200 rays with weights between 0 and 1.
        assert there == pytest.approx(back, rel=1e-2)


def test_linear_and_the_same_in_any_order_of_threads_and_blocks():
    positions, normals, faces = facing_squares(0.6, 8)
    stage = Stage(positions, normals, faces)
    rng = np.random.default_rng(5)
    one, two = (rng.random((len(positions), 3)).astype(np.float32) for _ in range(2))
    e1, e2 = (stage.bounce(stage.exit(x))[0] for x in (one, two))
    both, _, _ = stage.bounce(stage.exit(2 * one + two))
    np.testing.assert_allclose(both, 2 * e1 + e2, rtol=1e-5)
    parts = [slice(0, 50), slice(50, len(positions))]
    cut = join([build_gather(stage.hits[s], stage.bits[s], stage.receivers.normal[s]) for s in parts])
    for whole, again in zip(stage.gather, cut, strict=True):
        np.testing.assert_array_equal(whole, again)


def bowl(rings=20):
    """The lower half of a unit sphere, lit inside."""
    corners, triangles = sphere_grid(rings, 2 * rings, np.pi / 2, np.pi)
    return corners, -corners.astype(np.float32), triangles[:, ::-1].astype(np.int32).copy()


def lost_at_the_horizon(rings):
    """Share of the irradiance that arrives lower than the next face of a concave ball rises, at most.

    It ends on that face close by, where the interpolated normal still looks away from the ray: such points send
    nothing, in the path tracer as well.
    """
    return np.sin(np.pi / rings) ** 2


def test_bowl():
    # KT5: in a hemispherical bowl every point gets half of any even light: under sky 1 with albedo 0.8 the irradiances
    # over pi are 0.5, 0.2, 0.08. The rim is open to the sky beside the bowl and is left out.
    positions, normals, faces = bowl(32)
    stage = Stage(positions, normals, faces)
    inner = stage.receivers.position[:, 1] < -0.2
    light, found = stage.exit(0.8 * 0.5), []
    for _ in range(2):
        e, _, _ = stage.bounce(light)
        found.append(e[:, 0] / np.pi)
        light = stage.exit(0.8 * e / np.pi)
    # The horizon weighs double, as all light comes from the lower half of what is seen. Rays and texels: 0.3 %.
    lost = 2 * lost_at_the_horizon(32) + 3e-3
    assert 0.2 * (1 - lost) < found[0][inner].mean() < 0.2 * (1 + 3e-3)
    assert 0.08 * (1 - 2 * lost) < found[1][inner].mean() < 0.08 * (1 + 6e-3)
    assert found[0][inner].std() < 0.02 * 0.2


@pytest.mark.parametrize("rings", [12, 24])
def test_a_closed_furnace_keeps_its_light(rings):
    # Radiance 1 all around gives irradiance pi everywhere, but for the horizon; texels cut it to 1e-4.
    corners, triangles = sphere_grid(rings, 2 * rings)
    stage = Stage(corners, -corners.astype(np.float32), triangles[:, ::-1].astype(np.int32).copy())
    e, _, _ = stage.bounce(stage.exit(1.0))
    assert (e / np.pi).max() < 1.0 + 1e-3
    assert (e / np.pi).min() > 1.0 - lost_at_the_horizon(rings) - 1e-3


SHINY = [
    Material("m", "cook-torrance", (0, 0, 0), (0.9, 0.7, 0.5), f0=0.8, roughness=0.4),
    Material("m", "blinn-phong", (0, 0, 0), (0.9, 0.7, 0.5), shininess=20.0),
    Material("m", "phong", (0, 0, 0), (0.9, 0.7, 0.5), shininess=10.0),
]


@pytest.mark.parametrize("material", SHINY, ids=lambda m: m.model)
def test_lobe_towards_the_camera(material):
    # Against the sum over cells with the model itself, radiance from the source's diffuse light.
    positions, normals, faces = facing_squares(0.5, 6)
    stage = Stage(positions, normals, faces, material)
    rng = np.random.default_rng(6)
    view = rng.normal(size=(len(positions), 3)).astype(np.float32)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    light = stage.exit(rng.random((len(positions), 3)))
    _, specular, _ = stage.bounce(light, view)
    directions = cube.texel_directions(C).reshape(-1, 3)
    gather = stage.gather
    for i in range(0, len(positions), 7):
        expected = np.zeros(3)
        for z in range(gather.start[i], gather.start[i + 1]):
            n, v = stage.receivers.normal[i].astype(float), view[i].astype(float)
            s = lobes(
                stage.table.model[0], stage.table.parameters[0], tuple(n), tuple(directions[gather.cell[z]]), tuple(v)
            )
            expected += s[1] * gather.solid_angle[z] * light.diffuse[gather.source[z]]
        np.testing.assert_allclose(specular[i], expected * material.specular, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("material", SHINY, ids=lambda m: m.model)
def test_lobes_between_receivers(material):
    # What a shiny square sends on, against lobes evaluated in full: gather at every receiver, then towards each that
    # sees it. Factors leave out a tenth of these lobes, most of it finer than this light.
    positions, normals, faces = facing_squares(0.5, 6)
    stage = Stage(positions, normals, faces, material)
    rng = np.random.default_rng(7)
    light = stage.exit(rng.random((len(positions), 1)) * np.ones(3))
    _, _, lobe = stage.bounce(light, go_on=True)
    e, _, _ = stage.bounce(Exit(np.zeros((len(positions), 3), np.float32), lobe, stage.row))
    directions = cube.texel_directions(C).reshape(-1, 3)
    gather = stage.gather

    wide = widen(stage.table, LEAST_WIDTH)

    def sent(y, towards):
        total = 0.0
        n = tuple(stage.receivers.normal[y].astype(float))
        for z in range(gather.start[y], gather.start[y + 1]):
            d = tuple(directions[gather.cell[z]])
            s = lobes(wide.model[0], wide.parameters[0], n, d, tuple(towards))[1]
            total += s * gather.solid_angle[z] * light.diffuse[gather.source[z], 0]
        return total

    some = range(0, len(positions), 9)
    expected = [
        sum(
            gather.cosine[z] * sent(gather.source[z], -directions[gather.cell[z]])
            for z in range(gather.start[i], gather.start[i + 1])
        )
        for i in some
    ]
    found = e[list(some)] / material.specular
    np.testing.assert_allclose(found[:, 0], found[:, 2], rtol=1e-4)  # colour goes in once
    error = np.linalg.norm(found[:, 0] - expected) / np.linalg.norm(expected)
    assert error < 0.05

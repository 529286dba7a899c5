"""Errors and fractions of cells against dense sums over receivers and samples."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relightcli.core.brdf.models import SPECULAR, evaluate_many, pack_materials
from relightcli.core.lights import quadtree
from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.shade.cluster_sum import Fractions
from relightcli.core.transport import light_clusters as measure
from relightcli.core.transport.receivers import receiver_areas
from relightcli.scene.model import Material
from tests.core.brdf.reflectances import random_directions

N, RADIUS = 150, 0.2


@pytest.fixture
def cell():
    """Nine samples of a cell, what random receivers see of them, normals and areas."""
    rng = np.random.default_rng(5)
    axis = np.array([0.2, 0.9, 0.3])
    directions = axis / np.linalg.norm(axis) + rng.uniform(-RADIUS, RADIUS, (9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal = random_directions(N, 6).astype(np.float32)
    height = directions @ normal.T.astype(np.float64)
    seen = (rng.random((9, N)) < rng.random(N)) & (height > 0)
    seen[:, :40] = height[:, :40] > 0
    seen[:, 40:60] = False
    area = rng.random(N)
    return seen, directions, normal, area / area.sum()


def pack(seen):
    out = np.zeros((len(seen), 8 * -(-seen.shape[1] // 64)), np.uint8)
    bits = np.packbits(seen, axis=1, bitorder="little")
    out[:, : bits.shape[1]] = bits
    return out.view(np.uint64)


def spread(x, r):
    return np.where(x >= r, x, np.where(x > -r, (x + r) ** 2 / (4 * r), 0.0))


def dense(seen, directions, normal):
    """Fractions (N,), and errors (10, N): of the samples, then of even light."""
    height = directions @ normal.T.astype(np.float64)
    transfer = seen * np.maximum(height, 0)
    whole = spread(directions.mean(0) @ normal.T.astype(np.float64), RADIUS)
    f = np.minimum(np.divide(transfer.mean(0), whole, out=np.zeros(len(normal)), where=whole > 0), 1)
    # What all or no sample sees needs no fraction.
    f = np.where(seen.all(0), 1.0, np.where(seen.any(0), f, 0.0))
    errors = np.concatenate([f * spread(height, RADIUS) - transfer, (f * whole - transfer.mean(0))[None]])
    errors[:, seen.all(0) | ~seen.any(0)] = 0
    return f, errors


def test_spread_cosine_is_that_of_light_about_the_horizon():
    # The mean of max(0, c) for c even over x - r to x + r.
    for x in np.linspace(-0.5, 0.5, 21):
        c = np.maximum(x + RADIUS * (2 * (np.arange(20000) + 0.5) / 20000 - 1), 0)
        assert measure.spread_cosine(x, RADIUS) == pytest.approx(c.mean(), abs=1e-8)


def test_errors_and_fractions(cell):
    seen, directions, normal, area = cell
    f, errors = dense(seen, directions, normal)
    square = measure.visibility_errors(pack(seen), directions, RADIUS, normal, area)
    np.testing.assert_allclose(square, errors**2 @ area, rtol=1e-6, atol=1e-20)
    found = measure.fractions(pack(seen), directions, RADIUS, normal)
    np.testing.assert_array_equal(found, np.minimum(np.floor(255 * f + 0.5), np.where(seen.all(0), 255, 254)))
    assert len(np.unique(found)) > 20


def test_light_that_all_or_none_see_has_no_error(cell):
    _, directions, normal, area = cell
    above = (directions @ normal.T > 0).all(0)
    for seen in (np.tile(above, (9, 1)), np.zeros((9, N), bool)):
        assert (measure.visibility_errors(pack(seen), directions, RADIUS, normal, area) == 0).all()
        assert set(measure.fractions(pack(seen), directions, RADIUS, normal)) <= {0, 255}


def test_papers_error(cell):
    seen, directions, normal, _ = cell
    reflectance = np.random.default_rng(7).random(N)
    t = reflectance * seen * np.maximum(directions @ normal.T.astype(np.float64), 0)
    expected = np.sqrt(((t - t.mean(0)) ** 2).sum(1)) / N
    np.testing.assert_allclose(measure.paper_errors(pack(seen), directions, normal, reflectance), expected, rtol=1e-6)


def test_doubled_receivers_change_the_papers_error_alone(cell):
    seen, directions, normal, area = cell
    twice, half = np.repeat(seen, 2, axis=1), np.repeat(area, 2) / 2
    normals = np.repeat(normal, 2, axis=0)
    np.testing.assert_allclose(
        measure.visibility_errors(pack(twice), directions, RADIUS, normals, half),
        measure.visibility_errors(pack(seen), directions, RADIUS, normal, area),
        rtol=1e-12,
    )
    ratio = measure.paper_errors(pack(twice), directions, normals, np.ones(2 * N)) / measure.paper_errors(
        pack(seen), directions, normal, np.ones(N)
    )
    np.testing.assert_allclose(ratio, 1 / math.sqrt(2), rtol=1e-12)


def test_specular_lobes(cell):
    seen, directions, normal, area = cell
    table = pack_materials(
        [
            Material("a", "cook-torrance", (0.2,) * 3, (0.5,) * 3, f0=0.7, roughness=0.3),
            Material("b", diffuse=(0.4,) * 3),
        ]
    )
    material = np.zeros(N, np.int32)
    material[::3] = 1
    rows = np.flatnonzero(material == 0)
    view = random_directions(N, 8).astype(np.float32)
    lobes = measure.lobe_transfer(pack(seen), directions, normal, view, rows, material, table)
    black = np.zeros((N, 3))
    whole = np.stack([evaluate_many(table, material, black, normal, d[None], view)[:, 0] for d in directions])
    expected = (whole / np.maximum(table.parameters[material, SPECULAR], 1e-30) * seen)[:, rows]
    np.testing.assert_allclose(lobes, expected, rtol=1e-5, atol=1e-7)

    rng = np.random.default_rng(9)
    diffuse, specular = rng.random(N), rng.random(N)
    # Receivers whose samples agree still differ by their lobes.
    square = np.zeros(10)
    given = measure.add_glossy_errors(
        square, pack(seen), directions, RADIUS, normal, rows, lobes, diffuse, specular, area
    )
    full = dense_glossy(seen, directions, normal, rows, lobes, diffuse, specular)
    np.testing.assert_allclose(square, full**2 @ area[rows], rtol=1e-4, atol=1e-20)
    np.testing.assert_allclose(given[:-1], (specular[rows] * lobes) ** 2 @ area[rows], rtol=1e-5)


def dense_glossy(seen, directions, normal, rows, lobes, diffuse, specular):
    height = (directions @ normal.T.astype(np.float64))[:, rows]
    transfer = seen[:, rows] * np.maximum(height, 0)
    whole = spread(directions.mean(0) @ normal[rows].T.astype(np.float64), RADIUS)
    f = np.minimum(np.divide(transfer.mean(0), whole, out=np.zeros(len(rows)), where=whole > 0), 1)
    samples = diffuse[rows] * (f * spread(height, RADIUS) - transfer) + specular[rows] * (lobes.mean(0) - lobes)
    return np.concatenate([samples, (diffuse[rows] * (f * whole - transfer.mean(0)))[None]])


def test_areas_of_receivers_sum_to_the_mesh():
    positions = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0], [9, 9, 9], [1, 0, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 5, 1]], np.int32)  # a square, and a face without area
    vertex = np.array([3, 2, 1, 0, 5], np.int32)
    areas = receiver_areas(positions, faces, vertex)
    assert areas.sum() == pytest.approx(6)
    np.testing.assert_allclose(areas, [1, 2, 1, 2, 0], atol=1e-12)


def test_bits_of_lights_below_the_horizon_give_nothing():
    # Bits as refinement may leave them: set where the light stands below the horizon.
    rng = np.random.default_rng(11)
    directions, normal, area = random_directions(9, 12), random_directions(N, 13).astype(np.float32), rng.random(N)
    area /= area.sum()
    seen = rng.random((9, N)) < 0.5
    height = directions @ normal.T.astype(np.float64)
    assert (seen & (height < 0)).any()
    f, errors = dense(seen, directions, normal)
    square = measure.visibility_errors(pack(seen), directions, RADIUS, normal, area)
    np.testing.assert_allclose(square, errors**2 @ area, rtol=1e-6, atol=1e-20)
    found = measure.fractions(pack(seen), directions, RADIUS, normal)
    np.testing.assert_allclose(found, 255 * f, atol=1 + 1e-4)
    t = seen * np.maximum(height, 0)
    papers = measure.paper_errors(pack(seen), directions, normal, np.ones(N))
    np.testing.assert_allclose(papers, np.sqrt(((t - t.mean(0)) ** 2).sum(1)) / N, rtol=1e-6)


def test_what_all_samples_see_has_no_error_whatever_the_cosines():
    directions, normal = random_directions(9, 14), random_directions(N, 15).astype(np.float32)
    for value in (True, False):
        seen = np.full((9, N), value)
        assert not measure.visibility_errors(pack(seen), directions, RADIUS, normal, np.full(N, 1 / N)).any()
        assert (measure.fractions(pack(seen), directions, RADIUS, normal) == 255 * value).all()


@pytest.mark.parametrize("count", [1, 63, 64, 65, 130])
def test_receivers_fill_words_or_do_not(cell, count):
    seen, directions, normal, area = cell
    seen, normal, area = seen[:, -count:], normal[-count:], area[-count:]
    f, errors = dense(seen, directions, normal)
    square = measure.visibility_errors(pack(seen), directions, RADIUS, normal, area)
    np.testing.assert_allclose(square, errors**2 @ area, rtol=1e-6, atol=1e-20)
    found = measure.fractions(pack(seen), directions, RADIUS, normal)
    np.testing.assert_allclose(found, 255 * f, atol=1 + 1e-4)


def test_receivers_without_lobes(cell):
    seen, directions, normal, area = cell
    table = pack_materials([Material("matt", diffuse=(0.4,) * 3), Material("shiny", "phong", specular=(0.5,) * 3)])
    view = normal.copy()
    rows = np.arange(N)
    lobes = measure.lobe_transfer(pack(seen), directions, normal, view, rows, np.zeros(N, np.int32), table)
    assert lobes.shape == (9, N)
    assert not lobes.any()
    # Seen from behind nothing shines.
    assert not measure.lobe_transfer(pack(seen), directions, normal, -view, rows, np.ones(N, np.int32), table).any()
    lit = measure.lobe_transfer(pack(seen), directions, normal, view, rows, np.ones(N, np.int32), table)
    assert ((lit > 0) <= seen).all()
    assert lit.any()
    # Without lobes and of reflectance 1 what is added is the other receivers' error.
    square = np.zeros(10)
    given = measure.add_glossy_errors(
        square, pack(seen), directions, RADIUS, normal, rows, lobes, np.ones(N), np.ones(N), area
    )
    expected = dense_glossy(seen, directions, normal, rows, lobes, np.ones(N), np.ones(N))
    np.testing.assert_allclose(square, expected**2 @ area, rtol=1e-6, atol=1e-20)
    assert not given.any()
    none = np.zeros(0, np.int64)
    empty = measure.lobe_transfer(pack(seen), directions, normal, view, none, np.zeros(N, np.int32), table)
    square = np.full(10, 3.0)
    measure.add_glossy_errors(square, pack(seen), directions, RADIUS, normal, none, empty, np.ones(N), np.ones(N), area)
    np.testing.assert_array_equal(square, np.full(10, 3.0))


def test_flat_ground_about_the_horizon_is_not_taken_for_lit_by_all():
    # 64 receivers of one normal, a cell that is half below their horizon, its light in the lower half: none arrives.
    n = np.tile(np.float32([-0.6593070, 0.7467942, 0.0872499]), (64, 1))
    cell = (4, 24, 28, 44, 48)
    _, d = quadtree.samples(cell, 64)
    r = 0.5 * math.sqrt(float(quadtree.solid_angles(np.array([cell]), 64)[0]))
    height = d @ n[0].astype(np.float64)
    assert height.min() < 0 < height.max()
    f = measure.fractions(pack(np.tile(height > 0, (64, 1)).T), d, r, n)
    packed = Fractions([f[None]], n, np.array([r]))
    light = LeafLight(np.ones((1, 3)), np.repeat(d[height.argmin()][None, None], 3, 1))
    assert packed.by_receiver(packed.sum(light, 1)).min() >= 0

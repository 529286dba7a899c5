"""Irradiance and highlights of points, against one evaluation of the model after another."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.lights.points import Points
from relightcli.core.shade.seen_points import point_irradiance, point_lobes
from relightcli.scene.model import Material

MATERIALS = [
    Material("a", "cook-torrance", (0, 0, 0), (1, 1, 1), f0=0.6, roughness=0.2),
    Material("b", "phong", (0, 0, 0), (1, 1, 1), shininess=40.0),
]


def unit(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("threads", [1, 2])
def test_sums_over_the_points_that_are_seen(threads):
    rng = np.random.default_rng(5)
    points = Points(unit(rng, 7), rng.random((7, 3)) * 10.0 ** rng.integers(-2, 6, (7, 1)))
    normal, view = unit(rng, 50).astype(np.float32), unit(rng, 50).astype(np.float32)
    seen, material = rng.random((7, 50)) < 0.6, rng.integers(0, 2, 50).astype(np.int32)
    cosine = np.maximum(normal.astype(np.float64) @ points.direction.T, 0.0) * seen.T
    found = point_irradiance(seen, points, normal, threads)
    np.testing.assert_allclose(found, cosine @ points.flux, rtol=1e-12)
    rows = np.flatnonzero(rng.random(50) < 0.7)
    table = pack_materials(MATERIALS)
    expected = np.zeros((len(rows), 3))
    for k in range(7):
        light = np.tile(points.direction[k], (len(rows), 1))
        black = np.zeros((len(rows), 3))
        value = evaluate_many(table, material[rows], black, normal[rows], light, view[rows])
        expected += value * points.flux[k] * seen[k, rows, None]
    found = point_lobes(seen, points, normal, view, rows, material, table, threads)
    assert expected.max() > 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-10)

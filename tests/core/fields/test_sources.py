"""Local lights seen from around them, against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.fields.sampling import sample_points
from relightcli.core.fields.sources import rectangle_light, source_field
from relightcli.core.sphere import sh
from relightcli.scene.model import RectangleLight, SphereLight


def test_a_sphere_light_is_a_disc():
    light = SphereLight("l", (3, 4, 5), 0.5, (1, 2, 3))
    field = source_field(light, 4, 2, 4)
    np.testing.assert_array_equal(field.center, 0)
    points = sample_points(field.center, field.radii, 2, 0, 4 * 24).reshape(4, 24, 3)
    for s in range(4):
        p = points[s, 5]
        distance = np.linalg.norm(p)
        cosine = np.sqrt(1 - (0.5 / distance) ** 2)
        x, weight = np.polynomial.legendre.leggauss(8)  # exact: polynomials of degree 3 over a cap
        z = 0.5 * (1 + cosine) + 0.5 * (1 - cosine) * x
        phi = 2 * np.pi * np.arange(16) / 16
        flat = np.sqrt(1 - z * z)[:, None, None] * np.stack([np.cos(phi), np.sin(phi), 0 * phi], -1)
        d = flat + z[:, None, None] * [0, 0, 1]
        y = sh.harmonics(about_axis(d, -p / distance), 4).mean(1)
        wanted = (2 * np.pi * 0.5 * (1 - cosine) * weight) @ y
        np.testing.assert_allclose(field.radiance[s, 5], wanted[:, None] * np.array(light.radiance), atol=1e-6)


def about_axis(directions, axis):
    """Directions whose +Z is turned to the unit vector `axis`."""
    side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    return directions @ np.stack([side, np.cross(axis, side), axis])


@pytest.mark.parametrize("height", [0.1, 0.5, 1.0, 5.0])
def test_a_rectangle_above_its_centre(height):
    """Solid angle of a unit square from its axis, 4 asin(1 / (1 + 4 h^2)), and its form factor (KT6's limit)."""
    seen = rectangle_light(np.array([[0, height, 0]]), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), 3, 64)[0]
    solid_angle = seen[0] * np.sqrt(4 * np.pi)
    # 64 nodes along an edge: exact to e^-25 a tenth of an edge away, and better beyond
    assert solid_angle == pytest.approx(4 * np.arcsin(1 / (1 + 4 * height**2)), rel=1e-6)
    # Band 1 holds the vector irradiance: integral of the direction, along -Y.
    a = 0.5 / np.hypot(0.5, height)
    form = 4 / np.pi * a * np.arctan(0.5 / np.hypot(0.5, height))
    assert -seen[1] / np.sqrt(3 / (4 * np.pi)) == pytest.approx(np.pi * form, rel=1e-6)


def test_a_rectangle_shines_forwards_only():
    light = RectangleLight("l", (0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 1, 1))
    field = source_field(light, 3, 4, 4)
    points = sample_points(field.center, field.radii, 4, 0, 3 * 96).reshape(3, 96, 3)
    behind = points[..., 1] < 0
    assert not field.radiance[behind].any()
    assert (field.radiance[~behind][:, 0] > 0).all()

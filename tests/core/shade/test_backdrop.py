"""The environment through pixels, against its mean over many points."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.lights.latlong import lookup_many, make_latlong
from relightcli.core.shade.backdrop import FINE, backdrop
from relightcli.core.transport.camera import film_directions, make_film
from relightcli.scene.model import Camera

MANY = 32


@pytest.mark.parametrize("target", [(0.3, 0.1, -1.0), (0.1, 1.0, 0.05)], ids=["ahead", "zenith"])
def test_pixels_are_means_over_their_area(target):
    film = make_film(Camera("c", (5.0, 6.0, 7.0), (5 + target[0], 6 + target[1], 7 + target[2]), fov=70, size=(24, 16)))
    sky = make_latlong(np.random.default_rng(2).random((8, 16, 3)).astype(np.float32), 33.0)
    found = backdrop(sky, film)
    x, y = (np.arange(24 * MANY) + 0.5) / MANY, (np.arange(16 * MANY) + 0.5) / MANY
    points = lookup_many(sky, film_directions(film, x[None, :], y[:, None]))
    truth = points.reshape(16, MANY, 24, MANY, 3).mean(axis=(1, 3))
    # A border is off by 1 / (2 FINE) and its own sampling here by 1 / (2 MANY) of a difference below 1; two cross.
    assert np.abs(found - truth).max() < 2 * (0.5 / FINE + 0.5 / MANY)
    # Errors of borders at random places have the variance of a uniform step, 1 / (12 FINE^2) of the difference.
    assert np.sqrt(np.mean((found - truth) ** 2)) < 1.0 / (np.sqrt(12.0) * FINE)
    np.testing.assert_array_equal(backdrop(sky, film, threads=3), found)


def test_a_constant_sky_is_exact():
    film = make_film(Camera("c", (0, 0, 0), (0, 0, -1), size=(5, 4)))
    np.testing.assert_array_equal(backdrop(make_latlong(np.full((2, 4, 3), 0.1)), film), np.full((4, 5, 3), 0.1, "f4"))

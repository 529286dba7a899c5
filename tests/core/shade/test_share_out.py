"""Finer camera samples shared out among the receivers of their pixels."""

from __future__ import annotations

import numpy as np

from relightcli.core.shade.picture import share_out
from relightcli.core.shade.primary import Samples
from relightcli.core.transport.shading import Surface


def test_samples_go_to_the_nearest_receiver_of_their_object():
    # Pixel 0: two receivers of object 0, one of object 1; pixel 1: one of object 1; pixel 2: none.
    pixel = np.array([1, 0, 0, 0], np.int32)
    position = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 9]])
    objects = np.array([1, 0, 0, 1], np.int32)
    at = np.array([[0.1, 0, 0], [0.2, 0, 0], [0, 0, 1], [0, 0, 3], [0, 0, 4]])
    of_sample = np.array([0, 0, 1, 0, 0], np.int32)
    colour = np.array([[0.2] * 3, [0.6] * 3, [0.3] * 3, [0.8] * 3, [1.0] * 3])
    n = len(at)
    samples = Samples(
        np.array([0, 0, 0, 1, 2], np.int32),
        np.array([0.25, 0.5, 0.25, 1.0, 1.0], np.float32),
        np.zeros(n, np.int32),
        *np.zeros((2, n), np.float32),
        np.zeros((n, 3), np.float32),
        np.ones((1, 3), np.float32),
    )
    none = np.zeros((n, 3))
    seen = Surface(at, none, none, none, colour, none, np.zeros(n, np.int32), np.arange(n))
    own = np.full((4, 3), 0.5, np.float32)
    weight, texture, coverage = share_out(samples, seen, of_sample, pixel, position, objects, own)
    np.testing.assert_allclose(weight, [1, 0.75, 0, 0.25])
    np.testing.assert_allclose(texture[:, 0], [0.8, (0.25 * 0.2 + 0.5 * 0.6) / 0.75, 0.5, 0.3], rtol=1e-6)
    np.testing.assert_allclose(coverage, [[1, 1, 0]])

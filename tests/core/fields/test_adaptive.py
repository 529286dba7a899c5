"""Placing samples by measured error: less of it with as many shells, and no more directions than it takes."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.fields.adaptive import adaptive_radii, direction_error, least_resolution, shell_error
from relightcli.core.fields.field import shell_radii
from tests.core.fields.bodies import ball, body_of, grey, tracer_of


@pytest.fixture(scope="module")
def round_body():
    return ball(grey(0.5), 16, 2.0, (5, 0, 0))


@pytest.fixture(scope="module")
def board():
    """A thin plate, seen as a line or a rectangle."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-0.1, 0.1) for z in (-0.6, 0.6)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return body_of(corners, triangles, corners / np.linalg.norm(corners, axis=1)[:, None], grey(0.5))


@pytest.mark.parametrize("name", ["round_body", "board"])
def test_shells_where_the_field_bends(name, request):
    body = request.getfixturevalue(name)
    tracer = tracer_of(body)
    radii = adaptive_radii(tracer, body, 6)
    np.testing.assert_allclose(radii[[0, -1]] / body.radius, (1.02, 8.0))
    steps = np.diff(np.log(radii))
    assert steps.min() > 0
    assert steps[0] == steps.min()  # both bend most next to the object
    # Measured: 0.43 and 0.72 of the error of equal ratios.
    assert shell_error(tracer, body, radii) < 0.85 * shell_error(tracer, body, shell_radii(body.radius, 6))


def test_more_shells_and_directions_less_error(round_body):
    tracer = tracer_of(round_body)
    few, many = (shell_error(tracer, round_body, shell_radii(round_body.radius, n)) for n in (4, 8))
    assert many < few / 2
    coarse, fine = (direction_error(tracer, round_body, 2.04, n) for n in (2, 4))
    assert fine < coarse / 2  # of second order, but where it is coarse


def test_directions_as_many_as_it_takes(round_body):
    tracer, radius = tracer_of(round_body), 1.02 * round_body.radius
    error = direction_error(tracer, round_body, radius, 4)
    assert least_resolution(tracer, round_body, radius, 1.01 * error, choices=(4, 8)) == 4
    assert least_resolution(tracer, round_body, radius, 0.99 * error, choices=(4, 8)) == 8

"""Shared exits against the sums that they stand for."""

import numpy as np
import pytest

from relightcli.core.fields.build import field_samples, short
from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.proxies import place_proxies, proxy_weights
from relightcli.core.fields.self_transfer import solve
from relightcli.core.fields.shared_exits import LEFT, share_exits
from relightcli.scene.model import Material
from tests.core.fields.bodies import ball, body_of, bowl, grey, tracer_of

METAL = Material("m", "cook-torrance", (0.3, 0.3, 0.3), (0.6, 0.6, 0.6), f0=0.6, roughness=0.3)
GOLD = Material("m", "cook-torrance", (0.3, 0.2, 0.1), (0.6, 0.5, 0.2), f0=0.6, roughness=0.3)


def samples(body, exits):
    radii = shell_radii(body.radius, 4)
    return field_samples(tracer_of(body), body, exits, radii, 3, 0, 4 * 54, rays=256).transfer.astype(float)


def relative(ours, truth):
    return float(np.linalg.norm(ours - truth) / np.linalg.norm(truth))


def test_a_convex_object_sends_products_alone():
    """Nothing is reflected twice, so that no lights are needed beside the proxies' weights; sums of some 200 hits in
    float32, in another order."""
    body = ball(METAL, 8)
    proxies = place_proxies(body.point, 5)
    exits = solve(tracer_of(body), body, proxies).exits
    shared = short(body, exits, proxies)
    assert len(shared.basis) == 0
    assert shared.row.shape[2] == 16
    assert relative(samples(body, shared), samples(body, exits)) < 1e-6


@pytest.mark.parametrize("material", [METAL, GOLD])
def test_own_reflections_are_kept_to_what_was_asked(material):
    """A lobe weighs the rows differently on their way to a sample: three times LEFT is allowed (2.6 was the most seen
    over LEFT from 5e-4 to 0.1)."""
    body = bowl(material, 6)
    proxies = place_proxies(body.point, 4)
    exits = solve(tracer_of(body), body, proxies).exits
    truth = samples(body, exits)
    shared = short(body, exits, proxies)
    assert 0 < len(shared.basis) < exits.shape[2]
    assert relative(samples(body, shared), truth) < 3.0 * LEFT
    weights = proxy_weights(body.point, proxies, body.radius)
    rough = share_exits(exits, weights, left=20.0 * LEFT)
    assert len(rough.basis) < len(shared.basis)
    assert relative(samples(body, rough), truth) > relative(samples(body, shared), truth)
    whole = share_exits(exits, weights, left=0.0)
    assert relative(samples(body, whole), truth) < 2e-6  # as far as float32 carries it


def test_rows_are_what_they_stand_for():
    body = bowl(METAL, 6)
    proxies = place_proxies(body.point, 4)
    exits = solve(tracer_of(body), body, proxies).exits
    shared = short(body, exits, proxies)
    made = shared.weight[:, None, :, None] * shared.row[:, :, None, :16]
    made = made.reshape(exits.shape) + shared.row[:, :, 16:] @ shared.basis
    assert relative(made, exits.astype(float)) <= LEFT


def test_diffuse_objects_keep_one_row():
    body = bowl(grey(0.5), 6)
    exits = solve(tracer_of(body), body, place_proxies(body.point, 3)).exits
    assert short(body, exits, place_proxies(body.point, 3)) is exits
    dark = share_exits(np.zeros_like(exits), np.full((len(exits), 3), 1 / 3))
    assert dark.basis.shape == (0, 48)
    assert not dark.row.any()


def test_a_flat_object_of_two_sides():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    body = body_of(corners, [[0, 2, 1], [0, 3, 2]], np.tile([0, 1, 0], (4, 1)), METAL, two_sided=True)
    proxies = place_proxies(body.point, 2)
    exits = solve(tracer_of(body), body, proxies).exits
    assert relative(samples(body, short(body, exits, proxies)), samples(body, exits)) < 1e-6

"""Fields at albedos that were not simulated, against fields that were."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.fields.albedos import NODES, self_weights, transfer_at, transfer_weights
from relightcli.core.fields.build import build_field
from relightcli.core.fields.compression import compress
from relightcli.scene.model import Material
from tests.core.fields.bodies import ball, bowl, grey, tracer_of


def test_weights_are_exact_for_what_they_interpolate():
    """Squares for the self transfer, a times squares for what is sent; and nothing is sent by black."""
    a = np.array([0.0, 0.33, 1.0])
    nodes = np.array(NODES)
    for power in range(3):
        np.testing.assert_allclose(nodes**power @ self_weights(tuple(a)), a**power, atol=1e-14)
        np.testing.assert_allclose(nodes ** (power + 1) @ transfer_weights(tuple(a)), a ** (power + 1), atol=1e-14)
    assert self_weights((0.4, 0.4, 0.4)).shape == (3, 1)
    for n, node in enumerate(NODES):
        np.testing.assert_allclose(transfer_weights((node,) * 3)[:, 0], np.eye(3)[n], atol=1e-14)


def fields(make, material):
    body = make(material, rings=6, order=3)
    return build_field(tracer_of(body), body, shells=2, resolution=3, proxies=2, rays=128)


@pytest.mark.parametrize(("make", "bound"), [(ball, 1e-5), (bowl, 0.02)])
def test_other_albedos_are_those_of_a_simulation(make, bound):
    """Exact for a ball, which does not see itself. Half a sphere errs by its third order alone, as the rays are the
    same: by (1/2)^3 (a - 0.15) (a - 0.6) (a - 0.95) / (1 - a/2)^3 of even light, 1.1 % at most, and up to 1.6 % of what
    it sends of all lights together."""
    made, own = fields(make, Material("m", diffuse=NODES))
    for albedo in (0.05, 0.3, 0.45, 0.8, 1.0):
        wanted, wanted_own = fields(make, grey(albedo))
        weights = self_weights((albedo,) * 3)
        missing = np.linalg.norm(own.transfer @ weights - wanted_own.transfer) / np.linalg.norm(wanted_own.transfer)
        assert missing <= bound
        sent = made.transfer @ transfer_weights((albedo,) * 3)
        assert np.linalg.norm(sent - wanted.transfer) <= bound * np.linalg.norm(wanted.transfer)


def test_compressed_transfers_are_mixed_like_others():
    made, _ = fields(bowl, Material("m", diffuse=NODES))
    values = made.transfer.reshape(-1, *made.transfer.shape[2:])
    packed = compress(values, 4, terms=6)
    light = np.random.default_rng(0).normal(size=(values.shape[1], 3, 9))
    which = np.array([0, 7, 50])
    for colour in ((0.2, 0.5, 1.0), (0.3, 0.3, 0.3), (0.0, 0.0, 0.0)):
        weights = transfer_weights(colour)
        expected = packed.decompress() @ weights
        mixed = transfer_at(packed, colour)
        assert mixed.shape[3] == (3 if len(set(colour)) > 1 else 1)
        np.testing.assert_allclose(mixed.decompress(), expected, atol=1e-5)
        seen = np.einsum("smijc,mcj->sci", np.broadcast_to(expected, values.shape)[which], light)
        np.testing.assert_allclose(mixed.reflect(light, which), seen, atol=1e-5 * np.abs(light).max())

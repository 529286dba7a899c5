"""Fields at albedos that were not simulated, against fields that were."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.fields.albedos import NODES, Scaled, reflectance, self_weights, transfer_at, transfer_weights
from relightcli.core.fields.build import build_field
from relightcli.core.fields.compression import compress
from relightcli.core.fields.entities import PlainTransfer
from relightcli.core.sphere import cube
from relightcli.scene.model import Material
from tests.core.fields.bodies import EVEN, ball, bowl, grey, tracer_of


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


@pytest.mark.parametrize(
    "material",
    [
        Material("m", "cook-torrance", (0.1, 0.1, 0.1), (0.6, 0.3, 0.1), f0=0.5, roughness=0.4),
        Material("m", "blinn-phong", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), shininess=12.0),
        Material("m", "phong", (0.3, 0.2, 0.1), (0.5, 0.5, 0.5), shininess=6.0),
    ],
)
def test_reflectance_is_the_integral_of_the_brdf(material):
    """1 / pi times the integral of f cos cos over both hemispheres, by midpoints: 0.5 % of it at 96 x 48 directions of
    light; the responses are interpolated between widths, which leaves another 1 %."""
    body = ball(material, rings=4)
    packed = pack_materials([material])
    z, phi = (np.arange(48) + 0.5) / 48, (np.arange(96) + 0.5) / 96 * 2 * np.pi
    z, phi = (x.ravel() for x in np.meshgrid(z, phi))
    lights = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    up, total, steps = np.broadcast_to([0.0, 0.0, 1.0], lights.shape), np.zeros(3), (np.arange(24) + 0.5) / 24
    albedo = np.broadcast_to(np.array(material.diffuse), lights.shape)
    for cosine in steps:
        view = np.broadcast_to([np.sqrt(1 - cosine**2), 0.0, cosine], lights.shape)
        values = evaluate_many(packed, np.zeros(len(z), np.int32), albedo, up, lights, view)
        total += cosine * values.mean(axis=0) * 2 * np.pi * 2 / len(steps)
    found = reflectance(np.array(material.diffuse), np.array(material.specular), body.lobe)
    np.testing.assert_allclose(found, total, rtol=0.015)


def test_other_lobes_are_sent_in_proportion():
    """Under even light a ball sends the right power through a sphere around it: the sum over directions of the flux
    there, which band 1 is. The facets of 6 rings leave 2.2 % of it, those of 12 rings 0.6 %, of 24 rings 0.1 %."""
    old = Material("m", "cook-torrance", (0.3, 0.2, 0.1), (0.3, 0.3, 0.3), f0=0.5, roughness=0.3)
    new = Material("m", "cook-torrance", (0.1, 0.2, 0.3), (0.6, 0.5, 0.4), f0=0.9, roughness=0.6)
    (made, _), (wanted, _) = fields(ball, old), fields(ball, new)
    rho = [reflectance(np.array(m.diffuse), np.array(m.specular), ball(m, order=3).lobe) for m in (old, new)]
    values = made.transfer.reshape(-1, *made.transfer.shape[2:])
    even = np.zeros((values.shape[1], 3, values.shape[2]), np.float32)
    even[:, :, 0] = EVEN
    which = np.arange(len(values))
    found = Scaled(PlainTransfer(values), (rho[1] / rho[0]).astype(np.float32)).reflect(even, which)
    exact = PlainTransfer(wanted.transfer.reshape(values.shape)).reflect(even, which)
    outwards = np.concatenate([cube.texel_directions(3).reshape(-1, 3)] * 2)[:, [1, 2, 0]]
    weight = np.tile(cube.solid_angles(3).reshape(-1), 12)[:, None] * outwards
    power = [np.einsum("sm,scm->c", weight, sent[..., 1:4]) for sent in (found, exact)]
    np.testing.assert_allclose(*power, rtol=0.025)

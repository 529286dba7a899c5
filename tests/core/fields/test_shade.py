"""Shading by light of a few bands: clamped cosines, self transfer, lobes against quadrature."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relightcli.core.brdf.models import COOK_TORRANCE, evaluate_many, pack_materials
from relightcli.core.fields.body import clamped_cosine
from relightcli.core.fields.chain import incident
from relightcli.core.fields.shade import diffuse, make_receivers, never_negative, specular
from relightcli.core.shade.low_order import response
from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import rotation_matrices
from relightcli.scene.model import Material
from tests.core.brdf.reflectances import random_directions
from tests.core.fields.balls import even_sky, put, shadow, turned

COUNT = 40


def lights(seed):
    return np.random.default_rng(seed).normal(size=(COUNT, 3, 16)).astype(np.float32)


def test_diffuse_is_the_clamped_cosine():
    normals = random_directions(COUNT, 1).astype(np.float32)
    albedo = np.random.default_rng(2).random((COUNT, 3))
    r = Rotation.random(random_state=3).as_matrix()
    light = lights(4)
    made = make_receivers(normals, albedo, 4)
    found = diffuse(made, light, rotation_matrices(r, 4))
    h = clamped_cosine(4) * sh.harmonics(normals.astype(float) @ r.T, 4) / np.pi
    np.testing.assert_allclose(found, albedo * np.einsum("pi,pci->pc", h, light), atol=3e-6)
    np.testing.assert_array_equal(found, diffuse(made, light, rotation_matrices(r, 4), threads=2))


def test_self_transfer_is_applied():
    rng = np.random.default_rng(5)
    transfer = rng.normal(size=(COUNT, 3, 16, 16, 3)).astype(np.float32) / 16
    normals = random_directions(COUNT, 6).astype(np.float32)
    light = lights(7)
    found = diffuse(make_receivers(normals, np.ones((COUNT, 3)), 4, transfer), light, np.eye(16))
    received = np.einsum("pkijc,pcj->pci", transfer.astype(float), light)
    h = clamped_cosine(4) * sh.harmonics(normals.astype(float), 4) / np.pi
    np.testing.assert_allclose(found, np.einsum("pi,pci->pc", h, received), atol=1e-5)


@pytest.mark.parametrize("height", [1.3, 2.0, 4.5])
@pytest.mark.parametrize("cosine", [1.0, 0.8])
def test_shadow_of_a_ball_on_a_plane(height, cosine):
    # Under an even sky B = albedo (1 - F), F = cosine / H^2 where the ball clears the horizon.
    to_ball = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    entities = [put(shadow(16, 16), 0.4 * height * to_ball, scale=0.4)]
    sky = even_sky()
    light = incident(entities, np.zeros((1, 3)), np.full(1, -1, np.int32), sky, [np.zeros((1, 3, 16), np.float32)])
    made = make_receivers(np.array([[0, 0, 1]], np.float32), np.full((1, 3), 0.5), 4)
    factor = cosine / height**2
    # Bands beyond order 4 hold 2 % of a cap's cosine; between 16 shells occlusion errs by up to 1 % of a hemisphere.
    np.testing.assert_allclose(diffuse(made, light, np.eye(16)), 0.5 * (1 - factor), atol=0.5 * (0.02 * factor + 0.01))


def test_glossy_by_quadrature():
    # The lobe times cosine, integrated against light of order 4 over fine points of the hemisphere.
    material = Material("m", "cook-torrance", (0.0, 0.0, 0.0), (0.9, 0.6, 0.3), f0=0.5, roughness=0.4)
    packed = pack_materials([material])
    normals = random_directions(6, 8).astype(np.float32)
    r = Rotation.random(random_state=9).as_matrix()
    light = lights(10)[:6]
    view = normals + 0.7 * random_directions(6, 11)
    view = (view / np.linalg.norm(view, axis=1, keepdims=True)).astype(np.float32)
    made = make_receivers(normals, np.zeros((6, 3)), 4, shines=True)
    table = response(COOK_TORRANCE, packed.parameters[0], 4)
    found = specular(made, light, rotation_matrices(r, 4), view, table, np.array(material.specular))
    d = random_directions(60000, 12)
    local = turned(light, r.T)
    for p in range(6):
        up = d[d @ normals[p] > 0]
        f = evaluate_many(packed, np.int64(0), np.zeros(3), normals[p].astype(float), up, view[p].astype(float))
        values = sh.harmonics(up, 4) @ local[p].T
        expected = 4 * np.pi * (f * values).sum(0) / len(d)
        # 60,000 random directions: a standard error of 1 % of the light's size.
        np.testing.assert_allclose(found[p], expected, atol=0.03 * np.abs(light).max())


def test_never_negative():
    values, least = never_negative(np.array([[0.5, -0.25, 0.0]], np.float32))
    np.testing.assert_array_equal(values, [[0.5, 0, 0]])
    assert least == pytest.approx(-0.25)

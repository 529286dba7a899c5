"""Lobes as mixes of a few, and what objects send by them, against simulations of the very materials."""

import math

import numpy as np
import pytest

from relightcli.core.brdf.models import BLINN_PHONG, COOK_TORRANCE, MODEL_CODES, evaluate_many, pack_materials
from relightcli.core.fields.build import field_samples, short
from relightcli.core.fields.field import shell_radii
from relightcli.core.fields.lobe_functions import (
    FUNCTIONS,
    exits_by_function,
    function_weights,
    lobe_functions,
    mix,
    sent_evenly,
)
from relightcli.core.fields.proxies import place_proxies
from relightcli.core.fields.self_transfer import solve
from relightcli.core.shade.low_order import response, responses
from relightcli.scene.model import Material
from tests.core.fields.bodies import ball, bowl, tracer_of

ORDER = 4
OLD = Material("m", "cook-torrance", (0.6, 0.5, 0.4), (0.1, 0.1, 0.1), f0=0.2, roughness=0.6)
NEW = Material("m", "cook-torrance", (0.05, 0.1, 0.05), (0.9, 0.8, 0.6), f0=0.8, roughness=0.15)


@pytest.mark.parametrize(("model", "bound"), [(COOK_TORRANCE, 0.085), (BLINN_PHONG, 0.02)])
def test_lobes_are_mixes(model, bound):
    """Of all widths, those of mirrors (f0 = 1) relative to their own norm, of f0 = 0 to that of the mirror as wide.
    Scaling to the right power takes the mix a little off the best one. Bounds: what was measured, rounded up."""
    functions = lobe_functions(model, ORDER)
    assert functions.shape == (FUNCTIONS, 48, 10)
    x = (np.arange(48) + 0.5) / 48
    measure = np.sqrt(x * (1 - x * x))[:, None]
    for pair in responses(model, ORDER).table.astype(np.float32):
        size = np.linalg.norm(pair[1] * measure)
        for lobe in pair:
            found = np.tensordot(mix(functions, lobe), functions, 1)
            assert np.linalg.norm((found - lobe) * measure) <= bound * size
            assert sent_evenly(found) == pytest.approx(float(sent_evenly(lobe)), rel=1e-6)


def test_functions_are_mixes_of_themselves():
    functions = lobe_functions(COOK_TORRANCE, ORDER)
    for k in range(FUNCTIONS):
        np.testing.assert_allclose(mix(functions, functions[k]), np.eye(FUNCTIONS)[k], atol=1e-5)


@pytest.mark.parametrize(
    "material",
    [
        Material("m", "cook-torrance", (0.0, 0.0, 0.0), (0.6, 0.3, 0.1), f0=0.5, roughness=0.4),
        Material("m", "blinn-phong", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), shininess=12.0),
        Material("m", "phong", (0.0, 0.0, 0.0), (0.5, 0.5, 0.5), shininess=6.0),
    ],
)
def test_sent_evenly_is_the_integral_of_the_brdf(material):
    """1 / pi times the integral of f cos cos over both hemispheres, by midpoints: 0.5 % of it at 96 x 48 directions of
    light; the responses are interpolated between widths, which leaves another 1 %."""
    packed = pack_materials([material])
    z, phi = (np.arange(48) + 0.5) / 48, (np.arange(96) + 0.5) / 96 * 2 * np.pi
    z, phi = (x.ravel() for x in np.meshgrid(z, phi))
    lights = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    up, total, steps = np.broadcast_to([0.0, 0.0, 1.0], lights.shape), np.zeros(3), (np.arange(24) + 0.5) / 24
    for cosine in steps:
        view = np.broadcast_to([np.sqrt(1 - cosine**2), 0.0, cosine], lights.shape)
        values = evaluate_many(packed, np.zeros(len(z), np.int32), np.zeros(lights.shape), up, lights, view)
        total += cosine * values.mean(axis=0) * 2 * np.pi * 2 / len(steps)
    lobe = response(MODEL_CODES[material.model], packed.parameters[0], ORDER)
    np.testing.assert_allclose(np.array(material.specular) * sent_evenly(lobe), total, rtol=0.015)


def samples(body, exits):
    radii = shell_radii(body.radius, 3)
    return field_samples(tracer_of(body), body, exits, radii, 3, 0, 3 * 54, rays=128).transfer.astype(float)


def by_function(make, old, new):
    """What an object sends that was simulated with one material, when it has another, and what a simulation says."""
    one, other = make(old), make(new)
    proxies = place_proxies(one.point, 3)
    code = MODEL_CODES[old.model]
    transfer = solve(tracer_of(one), one, proxies).transfer
    exits = exits_by_function(one, code, transfer, np.ones(len(one.point)), proxies)
    seen = samples(one, exits)
    assert seen.shape[-1] == 1 + FUNCTIONS
    weights = function_weights(lobe_functions(code, ORDER), other.lobe, np.array(new.diffuse), np.array(new.specular))
    return seen @ weights, simulated(make, new)


def simulated(make, material):
    body = make(material)
    proxies = place_proxies(body.point, 3)
    return samples(body, short(body, solve(tracer_of(body), body, proxies).exits, proxies))


def small_ball(material):
    return ball(material, 8)


@pytest.mark.parametrize(
    ("old", "new", "bound"),
    [
        (OLD, NEW, 0.06),
        (NEW, OLD, 0.01),
        (OLD, OLD, 0.01),
        (
            Material("m", "blinn-phong", (0.2,) * 3, (0.5,) * 3, shininess=10.0),
            Material("m", "blinn-phong", (0.4, 0.1, 0.1), (0.3, 0.5, 0.5), shininess=70.0),
            0.02,
        ),
    ],
)
def test_other_materials_send_as_in_a_simulation(old, new, bound):
    """A ball, which does not see itself: what is left is that of the lobes' mixes, next to which the diffuse part is
    exact, and noise, of which both have the same."""
    found, truth = by_function(small_ball, old, new)
    assert np.linalg.norm(found - truth) <= bound * np.linalg.norm(truth)
    if old is not new:
        before = simulated(small_ball, old)
        assert np.linalg.norm(before - truth) > 3 * bound * np.linalg.norm(truth)


def test_own_reflections_stay_those_of_the_old_material():
    """In half a sphere, whose own light is a part: grey, so that colours are told apart by the weights alone."""
    found, truth = by_function(lambda m: bowl(m, 6), NEW, NEW)
    assert np.linalg.norm(found - truth) <= 0.1 * np.linalg.norm(truth)


def test_equal_colours_are_one():
    functions = lobe_functions(COOK_TORRANCE, ORDER)
    grey = function_weights(functions, functions[0], np.full(3, 0.5), np.full(3, 0.2))
    assert grey.shape == (1 + FUNCTIONS, 1)
    assert function_weights(functions, functions[0], np.full(3, 0.5), np.array([0.2, 0.2, 0.1])).shape == (5, 3)
    assert math.isclose(grey[0, 0], 0.5)

"""Lobes as sums of products: what is left out is known, and nothing depends on the azimuth's origin."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.brdf.models import lobes, pack_materials, widen
from relightcli.core.brdf.separable import LEAST_WIDTH, POLAR, ROWS, TERMS, polar_cosines, separate
from relightcli.scene.model import Material

WHITE = (1.0, 1.0, 1.0)
THETA = np.arccos(polar_cosines())


def row_of(**settings):
    table = pack_materials([Material("m", specular=WHITE, **settings)])
    return int(table.model[0]), table.parameters[0]


def exact(model, row, v, l):  # noqa: E741
    """The lobe at polar angle v of the view, (l, phi) of the light."""
    theta, phi = l
    d = (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
    return lobes(model, row, (0.0, 0.0, 1.0), d, (np.sin(v), 0.0, np.cos(v)))[1]


ORDER = np.concatenate([np.arange(count) for count in ROWS])


def rebuilt(terms, i, j, phi):
    return np.cos(np.multiply.outer(phi, ORDER)) @ (terms.view_factor[i] * terms.light_factor[j])


# What is left out, relative norm; the bounds are the numbers found, rounded up, so that none gets worse unnoticed.
LEFT_OUT = [
    ({"model": "blinn-phong", "shininess": 1.0}, 0.001),
    ({"model": "blinn-phong", "shininess": 10.0}, 0.01),
    ({"model": "blinn-phong", "shininess": 50.0}, 0.09),
    ({"model": "phong", "shininess": 10.0}, 0.15),
    ({"model": "cook-torrance", "roughness": 1.0, "f0": 0.8}, 0.08),
    ({"model": "cook-torrance", "roughness": 0.5, "f0": 0.8}, 0.13),
    ({"model": "cook-torrance", "roughness": 0.3, "f0": 0.8}, 0.24),
    ({"model": "cook-torrance", "roughness": 0.1, "f0": 0.8}, 0.78),
]


@pytest.mark.parametrize(("settings", "bound"), LEFT_OUT, ids=lambda x: str(x))
def test_what_is_left_out(settings, bound):
    # The norm is that of the docstring; quadrature on another grid of azimuths than the transform's.
    model, row = row_of(**settings)
    terms = separate(model, row)
    phi = (np.arange(45) + 0.37) * (2 * np.pi / 45)
    error = norm = 0.0
    for i in range(POLAR):
        for j in range(POLAR):
            # solid angle goes with p dp; p grows evenly with the index
            weight = (j + 0.5) * (i + 0.5) * np.cos(THETA[i])
            s = np.array([exact(model, row, THETA[i], (THETA[j], p)) for p in phi])
            error += weight * ((s - rebuilt(terms, i, j, phi)) ** 2).sum()
            norm += weight * (s**2).sum()
    found = np.sqrt(error / norm)
    assert 0.5 * bound < found < bound or found < bound < 0.02  # the others are exact but for the table


NARROW = [
    {"model": "cook-torrance", "roughness": 0.005, "f0": 1.0},
    {"model": "cook-torrance", "roughness": 0.005, "f0": 0.04},
    {"model": "blinn-phong", "shininess": 1e5},
    {"model": "phong", "shininess": 1e4},
]


@pytest.mark.parametrize("settings", NARROW, ids=lambda s: str(s))
def test_the_energy_is_kept(settings):
    # Light from one direction: what leaves over all directions, each by its cosine. Quadrature over the table's own
    # angles of the view; azimuths cancel but for order 0.
    table = widen(pack_materials([Material("m", specular=WHITE, **settings)]), LEAST_WIDTH)
    model, row = int(table.model[0]), table.parameters[0]
    terms = separate(model, row)
    phi = (np.arange(128) + 0.5) * (2 * np.pi / 128)
    weight = (np.arange(POLAR) + 0.5) * np.cos(THETA)
    for j, bound in ((4, 0.01), (16, 0.01), (28, 0.01), (34, 0.01), (42, 0.05)):
        true = [np.mean([exact(model, row, v, (THETA[j], p)) for p in phi]) for v in THETA]
        kept = [rebuilt(terms, i, j, phi).mean() for i in range(POLAR)]
        assert np.dot(weight, kept) == pytest.approx(np.dot(weight, true), rel=bound), np.degrees(THETA[j])


def test_one_product_for_what_is_a_product():
    # At exponent 0 the half-vector lobe is the cosine alone: one term of order 0, exact.
    model, row = row_of(model="blinn-phong", shininess=0.0)
    terms = separate(model, row)
    size = np.abs(terms.view_factor).max(axis=0) * np.abs(terms.light_factor).max(axis=0)
    assert (size[1:] < 1e-6 * size[0]).all()
    for v, l in ((0.1, 0.3), (1.2, 0.7)):  # noqa: E741
        i, j = (int(np.abs(THETA - x).argmin()) for x in (v, l))
        value = rebuilt(terms, i, j, np.array([0.0, 1.0, 2.5]))
        np.testing.assert_allclose(value, exact(model, row, THETA[i], (THETA[j], 1.0)), rtol=1e-5)


@pytest.mark.parametrize("f0", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.07, 10.0])
def test_extreme_lobes_stay_finite(roughness, f0):
    terms = separate(*row_of(model="cook-torrance", roughness=roughness, f0=f0))
    for factor in terms:
        assert factor.shape == (POLAR, TERMS)
        assert np.isfinite(factor).all()
        assert factor.any()


def test_the_same_lobe_is_not_separated_twice():
    # A picture asks for the factors of every lobe, and a sequence for the same ones in every frame.
    model, row = row_of(model="cook-torrance", roughness=0.31, f0=0.8)
    found = separate(model, row)
    assert separate(model, row.copy()) is found
    with pytest.raises(ValueError, match="read-only"):
        found.view_factor[0, 0] = 1.0
    row[:] = row_of(model="cook-torrance", roughness=0.32, f0=0.8)[1]
    assert separate(model, row) is not found

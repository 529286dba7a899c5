"""Lobes as sums of products: what is left out is known, and nothing depends on the azimuth's origin."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.brdf.models import lobes, pack_materials
from relightcli.core.brdf.separable import MOST_TERMS, POLAR, polar_cosines, separate
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


def rebuilt(terms, i, j, phi):
    waves = np.cos(np.multiply.outer(phi, terms.order))
    return waves @ (terms.view_factor[i] * terms.light_factor[j])


ROUGH = [
    {"model": "blinn-phong", "shininess": 1.0},
    {"model": "blinn-phong", "shininess": 20.0},
    {"model": "phong", "shininess": 10.0},
    {"model": "cook-torrance", "roughness": 0.5, "f0": 0.9},
    {"model": "cook-torrance", "roughness": 1.0, "f0": 0.0},
]


@pytest.mark.parametrize("settings", ROUGH, ids=lambda s: f"{s['model']} {list(s.values())[1]:g}")
@pytest.mark.parametrize("tolerance", [0.3, 0.1])
def test_what_is_left_out_is_the_tolerance(settings, tolerance):
    # The norm is that of the docstring; quadrature on another grid of azimuths than the transform's.
    model, row = row_of(**settings)
    terms = separate(model, row, tolerance)
    phi = (np.arange(90) + 0.37) * (2 * np.pi / 90)
    error = norm = 0.0
    for i in range(0, POLAR, 4):
        for j in range(0, POLAR, 4):
            # solid angle goes with p dp; p grows evenly with the index
            weight = (j + 0.5) * (i + 0.5) * np.cos(THETA[i])
            s = np.array([exact(model, row, THETA[i], (THETA[j], p)) for p in phi])
            error += weight * ((s - rebuilt(terms, i, j, phi)) ** 2).sum()
            norm += weight * (s**2).sum()
    found = np.sqrt(error / norm)
    # Every fourth angle is a sample of the grid: 10 % slack.
    assert found < 1.1 * tolerance or len(terms.order) == MOST_TERMS
    assert found < 0.45  # as bad as the most terms leave the narrowest of these lobes
    assert found > 0.1 * tolerance  # no more terms than needed


def test_one_product_for_what_is_a_product():
    # At exponent 0 the half-vector lobe is the cosine alone: one term of order 0, exact.
    model, row = row_of(model="blinn-phong", shininess=0.0)
    terms = separate(model, row, 1e-4)
    assert terms.order.tolist() == [0]
    for v, l in ((0.1, 0.3), (1.2, 0.7)):  # noqa: E741
        i, j = (int(np.abs(THETA - x).argmin()) for x in (v, l))
        value = rebuilt(terms, i, j, np.array([0.0, 1.0, 2.5]))
        np.testing.assert_allclose(value, exact(model, row, THETA[i], (THETA[j], 1.0)), rtol=1e-5)


@pytest.mark.parametrize("f0", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.07, 10.0])
def test_extreme_lobes_stay_finite(roughness, f0):
    terms = separate(*row_of(model="cook-torrance", roughness=roughness, f0=f0), 0.1)
    assert 0 < len(terms.order) <= MOST_TERMS
    assert np.isfinite(terms.view_factor).all()
    assert np.isfinite(terms.light_factor).all()
    assert (np.diff(terms.order) >= 0).all()

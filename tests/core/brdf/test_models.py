"""Values of the reflectance models against their definitions, energy, reciprocity, and extreme parameters."""

import math

import numpy as np
import pytest

from relightcli.core.brdf.models import evaluate_many, pack_materials
from tests.core.brdf.reflectances import (
    ALBEDO,
    SPECULAR,
    TRANSMITTANCE,
    N,
    direction,
    hemisphere,
    material,
    random_directions,
    value,
    white,
)


def by_definition(m, light, view):
    """The formulas of the module's docstring, term by term, for n.l > 0 and n.v > 0."""
    nl, nv = light[:, 2], view[:, 2]
    h = light + view
    h /= np.linalg.norm(h, axis=1)[:, None]
    nh, vh = h[:, 2], (view * h).sum(1)
    diffuse = ALBEDO / np.pi * nl[:, None]
    a, rough = m.shininess, m.roughness
    if m.model == "blinn-phong":
        lobe = nl * (a + 2) * (a + 4) / (8 * np.pi * (2 ** (-a / 2) + a)) * nh**a
    elif m.model == "cook-torrance":
        d = np.exp(-(1 / nh**2 - 1) / rough**2) / (np.pi * rough**2 * nh**4)
        g = np.minimum(1, np.minimum(2 * nh * nv / vh, 2 * nh * nl / vh))
        lobe = (m.f0 + (1 - m.f0) * (1 - vh) ** 5) * d * g / (4 * nv)
    elif m.model == "phong":
        r = np.stack([-view[:, 0], -view[:, 1], nv], -1)
        lobe = (a + 1) / (2 * np.pi) * np.maximum(0, (r * light).sum(1)) ** a
    else:
        lobe = 0 * nl
    return diffuse + SPECULAR * lobe[:, None]


@pytest.mark.parametrize(
    "m",
    [
        material("lambert"),
        material("translucent"),
        material("blinn-phong", shininess=3.0),
        material("blinn-phong", shininess=200.0),
        material("cook-torrance", roughness=0.2, f0=0.8),
        material("cook-torrance", roughness=1.5, f0=0.0),
        material("phong", shininess=1.0),
        material("phong", shininess=80.0),
    ],
    ids=lambda m: f"{m.model}-{m.roughness}-{m.shininess}",
)
def test_value_is_the_definition(m):
    light, view = random_directions(2000, 1, 0.01), random_directions(2000, 2, 0.01)
    # The naive cosines cost a few hundred roundings at these exponents.
    np.testing.assert_allclose(value(m, light, view), by_definition(m, light, view), rtol=1e-11, atol=1e-300)


@pytest.mark.parametrize("model", ["lambert", "blinn-phong", "cook-torrance", "phong"])
def test_nothing_comes_from_below_or_goes_there(model):
    light, view = random_directions(1000, 3), random_directions(1000, 4)
    out = value(material(model), light, view)
    seen = (light[:, 2] > 0) & (view[:, 2] > 0)
    assert not out[~seen].any()
    assert (out[seen] > 0).all()


def test_translucent_passes_light_from_behind():
    light = direction(math.pi - 0.3)
    np.testing.assert_allclose(
        value(material("translucent"), light, N), TRANSMITTANCE / math.pi * math.cos(0.3), rtol=1e-14
    )
    assert not value(material("translucent"), light, -N).any()


@pytest.mark.parametrize("shininess", [0.0, 1.0, 10.0, 1e3, 1e6])
@pytest.mark.parametrize("model", ["blinn-phong", "phong"])
def test_exponent_lobes_reflect_everything_at_normal_incidence(model, shininess):
    # Gauss-Legendre on panels that halve towards the pole, down to far below the lobe's width 1/sqrt(a).
    edges = np.r_[0.0, 0.5 * np.pi * 0.5 ** np.arange(30, -1, -1)]
    x, w = np.polynomial.legendre.leggauss(40)
    theta = (edges[:-1, None] + np.diff(edges)[:, None] * 0.5 * (x + 1)).ravel()
    weight = (np.diff(edges)[:, None] * 0.5 * w).ravel()
    lobe = value(white(model, shininess=shininess), direction(theta), N)[:, 0]
    assert 2 * np.pi * (weight * np.sin(theta) * lobe).sum() == pytest.approx(1, rel=1e-9)


@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0, 10.0, 1e3])
@pytest.mark.parametrize("theta", [0.0, 0.8, 1.4, 1.55])
def test_cook_torrance_never_reflects_more_than_it_gets(roughness, theta):
    light, weight = hemisphere()
    out = value(white("cook-torrance", roughness=roughness, f0=1.0), light, direction(theta))[:, 0]
    # 1e-3: the quadrature's error at the narrowest lobe.
    assert (out * weight).sum() < 1 + 1e-3


@pytest.mark.parametrize(
    "m", [material("lambert"), material("blinn-phong"), material("cook-torrance"), material("cook-torrance", f0=1.0)]
)
def test_reciprocity(m):
    a, b = random_directions(2000, 5, 1e-3), random_directions(2000, 6, 1e-3)
    np.testing.assert_allclose(value(m, a, b) / a[:, 2:], value(m, b, a) / b[:, 2:], rtol=1e-11)


def test_narrow_lobe_keeps_its_digits():
    # cos^1e6 at 1 mrad: the cosine itself has an error of 1e-16, its logarithm would be wrong by 2e-10 * 1e6.
    delta = 1e-3
    lobe = value(white("phong", shininess=1e6), direction(delta), N)[0]
    expected = (1e6 + 1) / (2 * math.pi) * math.exp(1e6 * math.log1p(-2 * math.sin(delta / 2) ** 2))
    assert lobe == pytest.approx(expected, rel=1e-10)
    half = value(white("blinn-phong", shininess=1e6), direction(2 * delta), N)[0]
    norm = (1e6 + 2) * (1e6 + 4) / (8 * math.pi * 1e6) * math.cos(2 * delta)
    assert half == pytest.approx(norm * math.exp(1e6 * math.log1p(-2 * math.sin(delta / 2) ** 2)), rel=1e-10)


@pytest.mark.parametrize(
    "m",
    [white("cook-torrance", roughness=r, f0=f) for r in (0.0, 1e-6, 1e-4, 1.0, 1e3) for f in (0.0, 1.0)]
    + [white(model, shininess=s) for model in ("blinn-phong", "phong") for s in (0.0, 1.0, 1e6)],
    ids=lambda m: f"{m.model}-{m.roughness}-{m.f0}-{m.shininess}",
)
def test_extremes_are_finite_and_not_negative(m):
    grazing = np.array([0.5 * np.pi - x for x in (0.0, 1e-15, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 0.5 * np.pi)])
    theta_l, theta_v, phi = (x.ravel() for x in np.meshgrid(grazing, grazing, [0.0, 1e-9, 1.0, np.pi, np.pi - 1e-12]))
    out = value(m, direction(theta_l), direction(theta_v, phi))
    assert np.isfinite(out).all()
    assert (out >= 0).all()


def test_mirror_peak_of_cook_torrance():
    # At l = v = n: D = 1/(pi m^2), G = 1, F = f0, over 4.
    for m in (1e-4, 0.3, 1e3):
        peak = value(white("cook-torrance", roughness=m, f0=0.7), N, N)[0]
        assert peak == pytest.approx(0.7 / (4 * math.pi * m * m), rel=1e-12)


def test_arguments_broadcast():
    table = pack_materials([material("lambert"), white("phong", shininess=2.0)])
    index = np.array([[0], [1]])
    light = random_directions(3, 7, 0.1)
    out = evaluate_many(table, index, ALBEDO, N, light, N)
    assert out.shape == (2, 3, 3)
    np.testing.assert_allclose(out[0], ALBEDO / np.pi * light[:, 2:], rtol=1e-14)


def test_unknown_model_is_an_error():
    with pytest.raises(KeyError, match="glass"):
        pack_materials([material("glass")])

"""The measured fits: the table, its conversion to our model, its normalisation, and energy."""

import csv
import re
from importlib import resources

import numpy as np
import pytest

from relightcli.core.brdf.measured import fits
from relightcli.core.brdf.models import MINIMUM_ROUGHNESS
from tests.core.brdf.reflectances import direction, material, value


def published():
    """(name, kd, ks, f0, m) as in the table."""
    text = resources.files("relightcli.core.brdf").joinpath("ngan2005.csv").read_text()
    header, *rows = csv.reader(line for line in text.splitlines() if not line.startswith("#"))
    assert header == ["name", "kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "f0", "m"]
    numbers = [[float(x) for x in row[1:]] for row in rows]
    return [(row[0], np.array(x[:3]), np.array(x[3:6]), x[6], x[7]) for row, x in zip(rows, numbers, strict=True)]


def by_ngan(kd, ks, f0, m, light, view):
    """f n.l of the published formula, in MERL's units times the scale of its reader."""
    nl, nv = light[:, 2], view[:, 2]
    h = light + view
    h /= np.linalg.norm(h, axis=1)[:, None]
    nh, vh = h[:, 2], (view * h).sum(1)
    beckmann = np.exp(-(1 / nh**2 - 1) / m**2) / (np.pi * m**2 * nh**4)
    geometry = np.minimum(1, np.minimum(2 * nh * nv / vh, 2 * nh * nl / vh))
    fresnel = f0 + (1 - f0) * (1 - vh) ** 5
    lobe = fresnel * beckmann * geometry / (np.pi * nl * nv)
    return np.array([1, 1.15, 1.66]) * (kd / np.pi + ks * lobe[:, None]) * nl[:, None]


def lobe_directions(m, view, rings=64, columns=64):
    """Mirrors l of `view` in half vectors distributed as D (n.h), those above the surface, with h, in strata."""
    u, v = (np.arange(rings) + 0.5) / rings, (np.arange(columns) + 0.5) / columns
    tangent = m * np.sqrt(-np.log1p(-u))
    h = direction(np.repeat(np.arctan(tangent), columns), np.tile(2 * np.pi * v, rings))
    vh = h @ view
    light = 2 * vh[:, None] * h - view
    return light, h, (light[:, 2] > 0) & (vh > 0)


def test_the_table_is_the_published_one(shared_data):
    number = r"([\d.e-]+)"
    colour = rf"\[{number}, {number}, {number}\]"
    pattern = (
        rf"^(\S+) = .*\(albedo = {colour}\), NganCookTorrance\(albedo = {colour}, eta = {number}, "
        rf"roughness = {number}\)"
    )
    text = (shared_data / "brdf" / "bbm_fits" / "ngan_cooktorrance.fit").read_text()
    rows = [(name, *map(float, x)) for name, *x in re.findall(pattern, text, re.MULTILINE)]
    assert len(rows) == 86
    assert [(name, *kd, *ks, f0, m) for name, kd, ks, f0, m in published()] == rows


def test_names_and_ranges():
    found = fits()
    assert len({f.name for f in found}) == 86
    for fit in found:
        assert re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", fit.name)
        assert min(fit.diffuse + fit.specular) > 0
        assert max(fit.diffuse) < 1
        assert 0 < fit.f0 < 1
        assert MINIMUM_ROUGHNESS < 1e-4 < fit.roughness < 10
    assert fits() is found


def test_one_fit_has_a_colour_above_one():
    above = {fit.name: fit.specular for fit in fits() if max(fit.specular) > 1}
    assert list(above) == ["colonial-maple-223"]
    # 4/pi times 0.981, 1.15 x 0.851 and 1.66 x 0.566
    assert above["colonial-maple-223"] == pytest.approx((1.249048, 1.246056, 1.196285), abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 50.0, 80.0])
def test_our_model_has_the_published_value(degrees):
    view = direction(np.radians(degrees))
    for fit, (name, kd, ks, f0, m) in zip(fits(), published(), strict=True):
        assert fit.name == name
        light, _, above = lobe_directions(m, view, 16, 16)
        light = light[above]
        ours = material("cook-torrance", diffuse=fit.diffuse, specular=fit.specular, f0=fit.f0, roughness=fit.roughness)
        theirs = by_ngan(kd, ks, f0, m, light, np.broadcast_to(view, light.shape))
        # The naive cosine of the narrowest lobe (m = 0.005) costs 1e-16/m^2 = 4e-12, times a few.
        np.testing.assert_allclose(value(ours, light, view), theirs, rtol=1e-10, err_msg=name)


def albedo(fit, degrees):
    """Directional albedo (3,): diffuse + specular E[F G (v.h) / ((n.v)(n.h))], h distributed as D (n.h)."""
    view = direction(np.radians(degrees))
    light, h, above = lobe_directions(fit.roughness, view)
    light, h, count = light[above], h[above], len(h)
    nv, vh, nh, nl = view[2], h @ view, h[:, 2], light[:, 2]
    geometry = np.minimum(1, 2 * nh * np.minimum(nl, nv) / vh)
    weight = (fit.f0 + (1 - fit.f0) * (1 - vh) ** 5) * geometry * vh / (nv * nh)
    return np.array(fit.diffuse) + np.array(fit.specular) * weight.sum() / count


def test_no_fit_reflects_more_than_it_gets():
    # At grazing angles every lobe is at its brightest. The largest found is 0.87, of colonial-maple-223; the error of
    # 64 x 64 strata is far below what is left to 1.
    largest = {fit.name: max(albedo(fit, degrees).max() for degrees in (0, 60, 85, 89, 89.5)) for fit in fits()}
    assert max(largest, key=largest.get) == "colonial-maple-223"
    assert 0.8 < max(largest.values()) < 0.9


def test_metals_are_as_dark_as_the_documentation_says():
    found = {fit.name: albedo(fit, 0).mean() for fit in fits()}
    # Rounded to whole percents there.
    assert found["chrome"] == pytest.approx(0.05, abs=0.005)
    assert found["aluminium"] == pytest.approx(0.09, abs=0.005)
    assert found["nickel"] == pytest.approx(0.16, abs=0.005)


def test_the_factor_of_the_lobe_agrees_with_the_ward_fits_of_the_same_paper(shared_data):
    # About l = v = n, Ward's isotropic lobe integrates to ks and ours to specular f0, both nearly. The two models
    # differ, so the ratio of the fits is near 1 and no more; metals (f0 of 0.2 and more) have it at 0.87. Had the table
    # meant ks F D G / ((n.l)(n.v)), it would be pi times that, and for ks F D G / (4 (n.l)(n.v)), pi/4 times.
    with open(shared_data / "brdf" / "ngan2005_ward.csv") as file:
        ward = {row["material"]: float(row["ks_g"]) for row in csv.DictReader(file)}
    ratios = [fit.specular[1] * fit.f0 / (1.15 * ward[fit.name]) for fit in fits() if fit.f0 >= 0.2]
    assert len(ratios) > 30
    away = [abs(np.log(np.median(ratios) * other)) for other in (1.0, np.pi, np.pi / 4)]
    assert away[0] == min(away)
    assert np.median(ratios) == pytest.approx(0.87, abs=0.02)

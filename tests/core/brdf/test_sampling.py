"""Sampling of the reflectance models: the directions follow the density, and the density is a density."""

import math

import numpy as np
import pytest
from numba import njit
from scipy import stats

from relightcli.core.brdf.models import evaluate_many, pack_materials
from relightcli.core.brdf.sampling import evaluate_and_pdf, orthonormal_frame, sample_direction
from tests.core.brdf.reflectances import direction, hemisphere, material, white

# An oblique normal, so that a mistake in the frame shows.
NORMAL = (0.48, 0.6, 0.64)


@njit
def draw(model, row, albedo, n, v, u):
    out = np.empty((len(u), 3))
    good = np.empty(len(u), np.bool_)
    for i in range(len(u)):
        d, good[i] = sample_direction(model, row, albedo, n, v, u[i, 0], u[i, 1])
        out[i, 0], out[i, 1], out[i, 2] = d
    return out, good


@njit
def densities(model, row, albedo, n, d, v):
    value = np.empty((len(d), 3))
    p = np.empty(len(d))
    for i in range(len(d)):
        f, p[i] = evaluate_and_pdf(model, row, albedo, n, (d[i, 0], d[i, 1], d[i, 2]), v)
        value[i, 0], value[i, 1], value[i, 2] = f
    return value, p


def setting(m, theta):
    """(model, row, albedo, n, v) and the frame (3, 3) whose third row is n."""
    table = pack_materials([m])
    s, t = orthonormal_frame(NORMAL)
    frame = np.array([s, t, NORMAL])
    v = direction(theta, 0.4) @ frame
    return (int(table.model[0]), table.parameters[0], tuple(float(c) for c in m.diffuse), NORMAL, tuple(v)), frame


MATERIALS = [
    material("lambert"),
    material("translucent"),
    material("blinn-phong", shininess=0.0),
    material("blinn-phong", shininess=30.0),
    material("phong", shininess=5.0),
    material("cook-torrance", roughness=0.3, f0=0.9),
    white("cook-torrance", roughness=0.5, f0=0.0),
    white("cook-torrance", roughness=3.0, f0=1.0),
    white("phong", shininess=0.0),
]


@pytest.mark.parametrize("theta", [0.2, 1.3])
@pytest.mark.parametrize("m", MATERIALS, ids=lambda m: f"{m.model}-{m.roughness}-{m.shininess}")
def test_directions_follow_the_density(m, theta):
    # Chi-square over 20 x 32 cells of (cos theta, phi); the density is integrated over each cell with 12 x 12 points.
    arguments, frame = setting(m, theta)
    n = 1_000_000
    u = np.random.default_rng(1).random((n, 2))
    d, good = draw(*arguments, u)
    local = d @ frame.T
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1, rtol=1e-12)
    z = np.clip(((local[:, 2] + 1) * 10).astype(int), 0, 19)
    phi = np.clip((np.mod(np.arctan2(local[:, 1], local[:, 0]), 2 * np.pi) / (2 * np.pi) * 32).astype(int), 0, 31)
    seen = np.bincount((z * 32 + phi)[good], minlength=640).astype(float)

    x, w = np.polynomial.legendre.leggauss(12)
    zs = (np.arange(20)[:, None] + 0.5 * (x + 1)).ravel() / 10 - 1
    ps = (np.arange(32)[:, None] + 0.5 * (x + 1)).ravel() / 32 * 2 * np.pi
    theta_grid, phi_grid = np.meshgrid(np.arccos(zs), ps, indexing="ij")
    _, p = densities(
        *arguments[:4], np.ascontiguousarray(direction(theta_grid, phi_grid).reshape(-1, 3) @ frame), arguments[4]
    )
    cell = p.reshape(20, 12, 32, 12)
    expected = n * np.einsum("aibj,i,j->ab", cell, 0.5 * w, 0.5 * w).ravel() * 0.1 * 2 * np.pi / 32
    used = expected > 50
    statistic = (((seen - expected) ** 2)[used] / expected[used]).sum()
    # Significance 0.01 over the 18 cases together (Sidak).
    assert stats.chi2.sf(statistic, used.sum()) > 1 - 0.99 ** (1 / 18)
    # What was refused is what the density leaves below the surface: 5 standard deviations of a count.
    assert abs(good.sum() - expected.sum()) < 5 * math.sqrt(n / 4) + 1e-4 * n


@pytest.mark.parametrize("m", [white("cook-torrance", roughness=1e-4), white("blinn-phong", shininess=1e6)])
def test_narrow_half_vectors(m):
    # P(tan^2 > x) is exp(-x/m^2), or (1 + x)^-((a+1)/2): uniform for the directions that were drawn.
    arguments, _ = setting(m, 0.5)
    d, good = draw(*arguments, np.random.default_rng(2).random((100_000, 2)))
    assert good.all()
    h = d + np.array(arguments[4])
    tan2 = (np.cross(NORMAL, h) ** 2).sum(1) / (h @ np.array(NORMAL)) ** 2
    tail = np.exp(-tan2 / 1e-8) if m.model == "cook-torrance" else (1 + tan2) ** (-0.5 * (1e6 + 1))
    assert stats.kstest(tail, "uniform").pvalue > 0.01


@pytest.mark.parametrize("theta", [0.0, 1.0, 1.5])
@pytest.mark.parametrize("m", MATERIALS, ids=lambda m: f"{m.model}-{m.roughness}-{m.shininess}")
def test_estimated_albedo_is_the_integral(m, theta):
    arguments, frame = setting(m, theta)
    d, good = draw(*arguments, np.random.default_rng(3).random((400_000, 2)))
    value, p = densities(*arguments[:4], d, arguments[4])
    assert (p[good] > 0).all()
    estimate = np.where(good[:, None], value / np.where(p > 0, p, 1)[:, None], 0)
    light, weight = hemisphere(200, 200)
    light, weight = np.concatenate([light, -light]), np.tile(weight, 2)
    exact = weight @ evaluate_many(
        pack_materials([m]), np.array(0), np.array(m.diffuse), np.array(NORMAL), light @ frame, np.array(arguments[4])
    )
    # 5 standard errors, plus the quadrature's own error where lobes are cut by the horizon.
    error = 5 * estimate.std(0) / math.sqrt(len(d)) + 1e-3
    assert (abs(estimate.mean(0) - exact) < error).all()


@pytest.mark.parametrize("n", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, -0.0), NORMAL, (1e-9, 0.0, -1.0)])
def test_frame_is_orthonormal_and_right_handed(n):
    s, t = orthonormal_frame(n)
    m = np.array([s, t, n])
    np.testing.assert_allclose(m @ m.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(m) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("v", [NORMAL, tuple(-np.array(NORMAL))])
def test_black_and_unseen_surfaces_give_no_direction(v):
    m = material("lambert", diffuse=(0, 0, 0)) if v == NORMAL else material("lambert")
    arguments, _ = setting(m, 0.0)
    _, good = draw(*arguments[:4], v, np.random.default_rng(4).random((10, 2)))
    assert not good.any()

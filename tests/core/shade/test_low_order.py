"""Light of few bands on any lobe, against quadrature; transfer's projections and rotations on the way."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.brdf.models import BLINN_PHONG, COOK_TORRANCE, PHONG, lobes_and_density, pack_materials
from relightcli.core.brdf.transport_basis import mix, transport_basis, white
from relightcli.core.shade.lobe_factors import axes_of, waves
from relightcli.core.shade.low_order import response, shade_low_order
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.transfer import (
    even_projection,
    light_factor_projections,
    local_rotations,
    used_terms,
)

ORDER = 4
DIRECTIONS = cube.texel_directions(64).reshape(-1, 3)
SOLID = np.tile(cube.solid_angles(64).reshape(-1), 6)


def random_unit(rng: np.random.Generator, count: int) -> np.ndarray:
    d = rng.standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("model", "width"), [(COOK_TORRANCE, 0.2), (COOK_TORRANCE, 0.8), (BLINN_PHONG, 40.0), (PHONG, 12.0)]
)
def test_specular_exit_radiance_is_the_integral_over_the_light(model: int, width: float) -> None:
    rng = np.random.default_rng(1)
    row = pack_materials([white(model, width, 0.6)]).parameters[0]
    normals = random_unit(rng, 5).astype(np.float32)
    view = np.array([n + 0.8 * v for n, v in zip(normals, random_unit(rng, 5), strict=True)])
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    world = rng.standard_normal((5, ORDER**2, 3))
    local = np.einsum("nij,njc->nci", local_rotations(normals, ORDER), world).astype(np.float32)
    table = response(model, row, ORDER)[None]
    one = np.ones((1, 3), np.float32)
    got, uniform = shade_low_order(
        np.arange(5), local, np.repeat(one, 5, 0), normals, view.astype(np.float32), table, one, np.zeros(5, np.int32)
    )
    light = np.einsum("ds,nsc->ndc", sh.harmonics(DIRECTIONS, ORDER), world)
    for i in range(5):
        n, v = tuple(normals[i].astype(np.float64)), tuple(view[i])
        lobe = np.array([lobes_and_density(model, row, n, tuple(d), v)[1] for d in DIRECTIONS])
        expected = (lobe * SOLID) @ light[i]
        scale = float((lobe * SOLID).sum()) * float(np.sqrt((light[i] ** 2).mean()))
        assert np.abs(got[i] - expected).max() <= 0.02 * scale
        assert np.abs(uniform[i] - (lobe * SOLID).sum()).max() <= 0.02 * (lobe * SOLID).sum()


def test_rotated_coefficients_give_the_same_function() -> None:
    rng = np.random.default_rng(2)
    normals = random_unit(rng, 4).astype(np.float32)
    rotation = local_rotations(normals, ORDER)
    coefficients = rng.standard_normal(ORDER**2)
    for i in range(4):
        axes = np.array(axes_of(tuple(normals[i].astype(np.float64))))
        world = sh.harmonics(DIRECTIONS, ORDER) @ coefficients
        local = sh.harmonics(DIRECTIONS @ axes.T, ORDER) @ (rotation[i] @ coefficients)
        assert np.abs(world - local).max() < 2e-5
        assert np.abs(rotation[i] @ rotation[i].T - np.eye(ORDER**2)).max() < 1e-5


def test_projections_of_cosine_and_light_factors_are_integrals() -> None:
    values = sh.harmonics(DIRECTIONS, ORDER)
    upper = np.maximum(DIRECTIONS[:, 2], 0.0) * SOLID / np.pi
    assert np.abs(upper @ values - even_projection(ORDER)).max() < 1e-3
    basis = transport_basis(COOK_TORRANCE)
    used = used_terms(99)
    wave = np.empty((2, basis.light_factor.shape[1]), np.float32)
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    total = np.zeros((len(used), ORDER**2))
    for d, solid, y in zip(DIRECTIONS, SOLID, values, strict=True):
        if waves(basis.light_factor, axes, tuple(d), wave):
            total += np.outer([wave[side, term] for side, term in used], solid * y)
    projected = light_factor_projections(basis.light_factor, ORDER)
    expected = np.array([projected[term, side] for side, term in used])
    assert np.abs(total - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize("model", [COOK_TORRANCE, BLINN_PHONG, PHONG])
def test_basis_is_uncentred_and_keeps_energy(model: int) -> None:
    fine = transport_basis(model, 8)
    coarse = transport_basis(model, 4)
    assert (fine.error <= coarse.error + 1e-6).mean() > 0.9  # of values; the fit is to values and energy together
    width = 0.5 if model == COOK_TORRANCE else 10.0
    row = pack_materials([white(model, width, 0.5)]).parameters[0]
    view = np.tensordot(mix(fine, row, model), fine.view_factor, 1)
    p = (np.arange(len(view)) + 0.5) / len(view)
    # Reflectance under even light: order 0 alone, 2 pi sum B_k sin theta dtheta.
    flat = 2.0 * np.pi * (fine.light_factor * (2.0 * p / len(p))[:, None]).sum(0)
    zero = [k for k, m in enumerate(_orders()) if m == 0]
    got = view[:, zero] @ flat[zero]
    truth = response(model, row, 1)[:, 0] * np.sqrt(4.0 * np.pi)
    steep = 1.0 - p**2 > 0.3
    assert np.abs(got / truth - 1.0)[steep].max() < 0.02


def _orders() -> list[int]:
    from relightcli.core.transport.transfer import ORDERS

    return [int(m) for m in ORDERS]

"""Compressed transfer fields: error promised and kept, light reflected in compressed form, odd inputs."""

import itertools

import numpy as np
import pytest

from relightcli.core.fields.compression import compress
from relightcli.core.fields.entities import PlainTransfer
from relightcli.errors import NumericalError
from tests.core.fields.balls import ball


def transfer():
    """4 shells x 96 directions of a ball with 2 proxies, order 3."""
    found = ball(order=3, shells=4, proxies=2).transfer
    return found.reshape(-1, *found.shape[2:])


def error(made, values):
    return np.linalg.norm(made.decompress().astype(float) - values) / np.linalg.norm(values)


@pytest.mark.parametrize("tolerance", [0.1, 0.02, 0.005])
def test_tolerance_is_kept_and_not_wasted(tolerance):
    values = transfer()
    made = compress(values, 4, tolerance=tolerance)
    assert made.error == pytest.approx(error(made, values), rel=1e-3)
    # 1 % of leeway: the rounding of coefficients is not counted.
    assert made.error <= 1.01 * tolerance
    assert made.error > 0.5 * tolerance


def test_error_falls_and_bytes_grow_with_terms():
    values = transfer()
    made = [compress(values, 4, terms=k) for k in (1, 2, 4, 8, 16)]
    errors, sizes = [m.error for m in made], [m.nbytes for m in made]
    assert all(a > b for a, b in itertools.pairwise(errors))
    assert all(a < b for a, b in itertools.pairwise(sizes))
    assert [len(m.component) for m in made] == [4, 8, 16, 32, 64]
    assert errors[-1] < errors[0] / 3
    m = made[2]
    bodies = m.component.nbytes + m.finer.nbytes + m.coefficient.nbytes
    assert sizes[2] == bodies + 4 * len(m.refined) + 8 * 16 + 4 * 5 + len(values)


def test_clusters_help_at_equal_terms():
    values = transfer()
    assert compress(values, 8, terms=4).error < 0.9 * compress(values, 1, terms=4).error


@pytest.mark.parametrize("colours", [1, 3])
def test_light_is_reflected_as_by_the_decompressed(colours):
    values = transfer()
    if colours == 3:
        values = np.concatenate([values, 0.5 * values, values[::-1]], axis=-1)
    made = compress(values, 4, terms=6)
    which = np.array([0, 5, 5, 300, 383, 37])
    light = np.random.default_rng(1).normal(size=(2, 3, 9))
    expected = PlainTransfer(made.decompress()).reflect(light, which)
    np.testing.assert_allclose(made.reflect(light, which), expected, atol=1e-5 * np.abs(expected).max())
    assert made.reflect(light, which[:0]).shape == (0, 3, 9)


def test_plain_transfer_is_the_sum_over_proxies():
    values = transfer()
    light = np.random.default_rng(2).normal(size=(2, 3, 9))
    expected = np.einsum("smijx,mcj->sci", values[[3, 70]].astype(float), light)
    np.testing.assert_allclose(PlainTransfer(values).reflect(light, np.array([3, 70])), expected, atol=1e-5)


def test_same_bytes_again():
    a, b = compress(transfer(), 4, terms=3), compress(transfer(), 4, terms=3)
    for name in ("cluster", "component", "scale", "finer", "refined", "coefficient", "coefficient_scale"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("kind", ["zero", "constant", "one", "few"])
def test_odd_inputs(kind):
    values = transfer()[:20]
    if kind == "zero":
        values = np.zeros_like(values)
    elif kind == "constant":
        values = np.ones_like(values)
    elif kind == "one":
        values = values[:1]
    made = compress(values, 8, terms=30)
    assert np.isfinite(made.decompress()).all()
    assert made.error < 1e-3


def test_what_is_not_finite_is_refused():
    values = transfer().copy()
    values[3, 0, 0, 0, 0] = np.nan
    with pytest.raises(NumericalError, match="finite"):
        compress(values)

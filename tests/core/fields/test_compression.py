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
    # 1 % of leeway: rounding is counted as evenly spread errors, of half a step at most.
    assert made.error <= 1.01 * tolerance
    assert made.error > 0.8 * tolerance


def entropy_bytes(codes):
    """What an ideal coder of single numbers takes."""
    _, count = np.unique(codes, return_counts=True)
    return float(-(count * np.log2(count / codes.size)).sum()) / 8


def test_error_falls_and_bytes_grow_with_terms():
    values = transfer()
    made = [compress(values, 4, terms=k) for k in (1, 2, 4, 8, 16)]
    errors = [m.error for m in made]
    sizes = [entropy_bytes(m.component) + entropy_bytes(m.coefficient) for m in made]
    assert all(a > b for a, b in itertools.pairwise(errors))
    assert all(a < b for a, b in itertools.pairwise(sizes))
    assert [len(m.component) for m in made] == [4, 8, 16, 32, 64]
    assert errors[-1] < errors[0] / 3


def test_rounding_takes_its_share_of_the_error_and_no_more():
    """By the terms alone, not rounded, what is left is 1 - 0.2 - 0.1 of the square of the error."""
    values = transfer().reshape(-1, 2 * 81)
    made = compress(transfer(), 4, tolerance=0.02)
    left = 0.0
    for h in range(len(made.start) - 1):
        own = values[made.cluster == h].astype(float)
        spectrum = np.linalg.svd(own - own.mean(0), compute_uv=False) ** 2
        left += spectrum[made.start[h + 1] - made.start[h] - 1 :].sum()
    square = made.error**2 * (values.astype(float) ** 2).sum()
    assert 0.05 * square < square - left < 0.35 * square  # the last term is not cut in parts
    # That is what makes the numbers short.
    assert entropy_bytes(made.component) < 0.75 * made.component.nbytes / 2
    assert entropy_bytes(made.coefficient) < 0.75 * made.coefficient.nbytes / 2


def test_slabs_that_are_read_one_by_one_give_the_same():
    values = transfer()
    whole, parts = (
        compress(values, 4, tolerance=0.02),
        compress([values[:96], values[96:100], values[100:]], 4, tolerance=0.02),
    )
    np.testing.assert_array_equal(whole.cluster, parts.cluster)
    assert parts.error == pytest.approx(whole.error, rel=1e-3)  # sums of floats in another order
    np.testing.assert_array_equal(parts.decompress(90, 120), parts.decompress()[90:120])


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
    for name in ("cluster", "component", "scale", "coefficient", "coefficient_scale"):
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

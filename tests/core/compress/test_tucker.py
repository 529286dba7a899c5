"""Tucker decompositions: exact ranks, errors that never rise, pairs kept whole, and degenerate tensors."""

import itertools

import numpy as np
import pytest

from relightcli.core.compress import tucker
from relightcli.core.compress.tucker import (
    gram_spectrum,
    hooi,
    hosvd,
    mode_gram,
    mode_product,
    pair_safe_rank,
    sequential_hosvd,
)
from relightcli.core.compress.tucker import reconstruct as rebuilt
from relightcli.errors import NumericalError

EPS = np.finfo(np.float64).eps


def of_rank(shape, ranks, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(ranks)
    for mode in range(3):
        x = mode_product(x, np.linalg.qr(rng.standard_normal((shape[mode], ranks[mode])))[0], mode)
    return x


def noise(shape=(7, 11, 13), seed=1):
    return np.random.default_rng(seed).standard_normal(shape)


def falling(shape=(8, 20, 20), seed=2):
    """Noise whose singular values fall, as those of data do: HOSVD and HOOI then differ."""
    x = noise(shape, seed)
    for mode in range(3):
        x *= (0.7 ** np.arange(shape[mode])).reshape([-1 if m == mode else 1 for m in range(3)])
    return mode_product(x, np.linalg.qr(noise((shape[1], shape[1], 1))[:, :, 0])[0], 1)


def squared(x):
    return float((x**2).sum())


@pytest.mark.parametrize("method", [hosvd, hooi])
def test_exact_ranks_are_recovered(method):
    x = of_rank((9, 17, 23), (3, 4, 5))
    found = method(x, (3, 4, 5))
    # Round-off of a few products of 23 terms; nothing in this tensor is badly conditioned.
    np.testing.assert_allclose(rebuilt(found), x, atol=1e-13 * np.abs(x).max())
    assert found.error2 <= 100 * EPS * found.norm2


@pytest.mark.parametrize("ranks", [(3, 4, 5), (2, 3, 3), (None, 4, 5), (2, None, 3), (None, None, 4), (7, 11, 13)])
def test_the_reported_error_is_that_of_the_reconstruction(ranks):
    x = noise()
    for found in (hosvd(x, ranks), hooi(x, ranks)):
        assert found.norm2 == pytest.approx(squared(x), rel=1e-14)
        # |X|^2 - |G|^2 cancels: its round-off is that of |X|^2.
        assert found.error2 == pytest.approx(squared(x - rebuilt(found)), abs=1e-13 * found.norm2)
        for mode, factor in enumerate(found.factors):
            assert (factor is None) == (ranks[mode] is None)
            if factor is not None:
                np.testing.assert_allclose(factor.T @ factor, np.eye(factor.shape[1]), atol=1e-13)


@pytest.mark.parametrize(
    ("x", "ranks"),
    [(noise(seed=k), r) for k in range(3) for r in ((2, 3, 3), (1, 1, 1), (None, 3, 4))] + [(falling(), (3, 4, 4))],
)
def test_hooi_never_rises_and_is_never_worse_than_hosvd(x, ranks):
    first, last = hosvd(x, ranks), hooi(x, ranks)
    assert last.errors[0] == first.error2
    # Round-off of |X|^2 - |G|^2.
    assert (np.diff(last.errors) <= 1e-13 * last.norm2).all()
    assert len(last.errors) - 1 <= tucker.MAXIMUM_SWEEPS


def test_hooi_gains_on_hosvd():
    # Noise has no structure that HOSVD could find in one step: HOOI must find more energy.
    assert hooi(noise(), (2, 3, 3)).error2 < 0.99 * hosvd(noise(), (2, 3, 3)).error2


def test_hosvd_error_is_below_the_discarded_energy_of_all_modes():
    # [De Lathauwer 2000, property 10]
    x, ranks = falling(), (3, 5, 4)
    tails = sum(np.linalg.eigvalsh(mode_gram(x, m))[: -ranks[m]].sum() for m in range(3))
    assert hosvd(x, ranks).error2 <= tails * (1 + 1e-12)


def test_one_mode_is_the_singular_value_decomposition():
    x = noise()
    singular = np.linalg.svd(np.moveaxis(x, 1, 0).reshape(11, -1), compute_uv=False)
    found = hooi(x, (None, 4, None))
    assert found.error2 == pytest.approx((singular[4:] ** 2).sum(), rel=1e-12)
    assert found.core.shape == (7, 4, 13)


def test_it_stops_at_the_limit_of_sweeps_and_when_nothing_changes():
    assert len(hooi(noise(), (2, 3, 3), sweeps=2).errors) == 3
    done = hooi(noise(), (2, 3, 3), sweeps=1000)
    change = -np.diff(done.errors) / np.array(done.errors[:-1])
    assert change[-1] <= 1e-6
    assert (change[:-1] > 1e-6).all()


def test_signs():
    for factor in hooi(falling(), (3, 4, 5)).factors:
        assert (factor[np.abs(factor).argmax(0), np.arange(factor.shape[1])] > 0).all()


def test_unfoldings_and_products_agree_with_einsum():
    x = noise((3, 4, 5))
    for mode, letters in enumerate(("ajk,bjk->ab", "iak,ibk->ab", "ija,ijb->ab")):
        np.testing.assert_allclose(mode_gram(x, mode), np.einsum(letters, x, x), atol=1e-13)
        matrix = noise((2, x.shape[mode], 1))[:, :, 0]
        letters = ("ijk,ri->rjk", "ijk,rj->irk", "ijk,rk->ijr")[mode]
        np.testing.assert_allclose(mode_product(x, matrix, mode), np.einsum(letters, x, matrix), atol=1e-13)


def test_ranks_are_cut_down_to_the_data():
    x = of_rank((9, 17, 23), (3, 4, 5))
    found = hooi(x, (100, 100, 100))
    assert found.core.shape == (3, 4, 5)
    assert found.closed == ()
    # Two rows along the first mode leave at most 2 * 3 directions for the second.
    assert hooi(noise(), (2, 11, 3)).core.shape == (2, 6, 3)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 5), (4, 1, 3), (3, 2, 1)])
@pytest.mark.parametrize("ranks", [(1, 1, 1), (2, 2, 2), (None, 2, 2)])
def test_tiny_and_constant_tensors(shape, ranks):
    x = np.full(shape, 2.0)
    found = hooi(x, ranks, paired=(1, 2))
    # A constant has rank 1 in every mode, whatever is asked.
    assert found.core.shape == tuple(n if r is None else 1 for n, r in zip(shape, ranks, strict=True))
    np.testing.assert_allclose(rebuilt(found), x, rtol=1e-14)


def test_the_zero_tensor():
    found = hooi(np.zeros((3, 4, 5)), (2, 2, 2), paired=(1, 2))
    assert found.core.shape == (1, 1, 1)
    assert found.error2 == 0
    assert not rebuilt(found).any()


def test_scale_changes_nothing_else():
    x = falling()
    plain, scaled = hooi(x, (3, 4, 4)), hooi(x * 2.0**-200, (3, 4, 4))
    # Powers of two: the same digits throughout.
    assert scaled.errors == tuple(e * 2.0**-400 for e in plain.errors)


def test_single_precision_input():
    x = falling()
    found = hooi(x.astype(np.float32), (3, 4, 4))
    assert found.core.dtype == np.float64
    # float32 rounds each value by 6e-8.
    assert found.error2 == pytest.approx(hooi(x, (3, 4, 4)).error2, rel=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_values_that_are_not_finite(bad):
    x = noise()
    x[1, 2, 3] = bad
    with pytest.raises(NumericalError, match="finite"):
        hooi(x, (2, 2, 2))


@pytest.mark.parametrize("ranks", [(0, 1, 1), (1, 1)])
def test_impossible_ranks(ranks):
    with pytest.raises(ValueError, match="three ranks"):
        hooi(noise(), ranks)


def test_a_rising_error_is_reported(monkeypatch):
    # Directions taken from the wrong end, from the first sweep on.
    calls = itertools.count()

    def spectrum(gram):
        values, vectors = gram_spectrum(gram)
        return (values, vectors) if next(calls) < 3 else (values, vectors[:, ::-1])

    monkeypatch.setattr(tucker, "gram_spectrum", spectrum)
    with pytest.raises(NumericalError, match="rose in sweep 1"):
        hooi(noise(), (2, 3, 3))


@pytest.mark.parametrize(
    ("spectrum", "safe"),
    [
        ([8, 4, 4, 2, 2, 1], [1, 3, 3, 5, 5, 6]),
        ([8, 8, 4, 4, 1], [2, 2, 4, 4, 5]),
        ([5, 4.95, 3, 2], [2, 2, 3, 4]),  # 1 % apart
        ([5, 4.85, 3, 2], [1, 2, 3, 4]),  # 3 % apart
        # A single value near a pair: the closer two belong together.
        ([4.04, 4, 4, 1], [1, 3, 3, 4]),
        ([4, 4, 3.96, 1], [2, 2, 3, 4]),
        ([1, 1, 1, 1], [2, 2, 4, 4]),
        ([3, 0, 0], [1, 2, 3]),  # zeros are nothing that could be cut
        ([0.0], [1]),
    ],
)
def test_pairs(spectrum, safe):
    assert [pair_safe_rank(np.array(spectrum, float), r) for r in range(1, len(spectrum) + 1)] == safe
    assert pair_safe_rank(np.array(spectrum, float), 100) == len(spectrum)


def circulant_tensor():
    """Three symmetric circulant matrices: eigenvectors are (cos m phi, sin m phi), each pair of one eigenvalue."""
    n = 12
    shift = (np.arange(n)[:, None] - np.arange(n)) % n
    distance = np.minimum(shift, n - shift)
    return np.stack([np.exp(-distance / width) for width in (1.0, 2.0, 4.0)])


@pytest.mark.parametrize("rank", range(1, 12))
def test_a_rank_that_would_cut_a_pair_is_moved_up(rank):
    found = hooi(circulant_tensor(), (2, rank, rank), paired=(1, 2))
    # 1 constant, then pairs, then 1 alternating: whole at 1, 3, 5, ..., 11.
    closed = rank + (rank % 2 == 0)
    assert [f.shape[1] for f in found.factors[1:]] == [closed, closed]
    assert found.closed == ((1, 2) if closed > rank else ())
    # Whole pairs: turning both indices by one step changes nothing but digits.
    near = rebuilt(found)
    np.testing.assert_allclose(np.roll(near, (1, 1), (1, 2)), near, atol=1e-12 * np.abs(near).max())


def test_cutting_a_pair_would_be_seen():
    near = rebuilt(hooi(circulant_tensor(), (2, 4, 4)))
    assert np.abs(np.roll(near, (1, 1), (1, 2)) - near).max() > 1e-3 * np.abs(near).max()


@pytest.mark.parametrize("ranks", [(8, None, 6), (5, 7, 4), (20, None, None), (55, None, 25)])
def test_sequential_is_near_the_optimum(ranks):
    # Singular values that fall off slowly, as those of transport do.
    rng = np.random.default_rng(3)
    x = rng.standard_normal((60, 20, 30)).astype(np.float32)
    for mode, size in enumerate(x.shape):
        x = np.moveaxis(np.moveaxis(x, mode, -1) * np.arange(1, size + 1) ** -1.0, -1, mode)
    found, best = sequential_hosvd(x, ranks), hooi(x, ranks)
    assert found.error2 <= 1.02 * best.error2
    back = rebuilt(found)
    assert ((x - back) ** 2).sum() == pytest.approx(found.error2, rel=1e-4)
    for factor, rank in zip(found.factors, ranks, strict=True):
        if rank is None:
            assert factor is None
        else:
            np.testing.assert_allclose(factor.T @ factor, np.eye(rank), atol=1e-12)


def test_sequential_takes_no_more_rank_than_there_is():
    rng = np.random.default_rng(4)
    x = np.einsum("ai,bi,ci->abc", *(rng.standard_normal((n, 3)) for n in (40, 6, 9))).astype(np.float32)
    found = sequential_hosvd(x, (200, None, 200))
    # A difference of squares of float32 products: known to a few roundings of 1.2e-7, whose sign is the processor's.
    assert found.error2 <= 5e-7 * found.norm2
    zero = sequential_hosvd(np.zeros((5, 4, 3), np.float32), (2, None, 2))
    assert zero.error2 == 0.0
    with pytest.raises(ValueError, match="three ranks"):
        sequential_hosvd(x, (0, None, 1))

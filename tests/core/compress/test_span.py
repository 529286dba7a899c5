"""Columns that span the others, against singular values and by construction."""

import numpy as np

from relightcli.core.compress.span import span


def matrix(rank=5, columns=12):
    rng = np.random.default_rng(4)
    return rng.standard_normal((40, rank)) * 10.0 ** -np.arange(rank) @ rng.standard_normal((rank, columns))


def test_chosen_columns_make_up_all_others():
    a = matrix()
    chosen, basis = span(a.T @ a, most=5)
    assert len(set(chosen.tolist())) == 5
    np.testing.assert_allclose(basis[:, chosen], np.eye(5), atol=1e-12)
    np.testing.assert_allclose(a[:, chosen] @ basis, a, atol=1e-9 * np.abs(a).max())  # squares of 1e-4 in a Gram matrix


def test_what_is_left_is_what_was_allowed_and_is_least_squares():
    a = matrix()
    gram = a.T @ a
    for allowed in (1e-1, 1e-3, 1e-5):
        chosen, basis = span(gram, allowed * np.trace(gram))
        left = ((a - a[:, chosen] @ basis) ** 2).sum()
        assert left <= allowed * np.trace(gram) * (1 + 1e-6)
        best = np.linalg.lstsq(a[:, chosen], a, rcond=None)[0]
        np.testing.assert_allclose(basis, best, atol=1e-6 * np.abs(best).max())
    few, many = (len(span(gram, t * np.trace(gram))[0]) for t in (1e-1, 1e-5))
    assert few < many


def test_groups_are_filled_up_and_nothing_spans_nothing():
    a = matrix()
    assert len(span(a.T @ a, 0.1 * (a**2).sum(), group=4)[0]) == 4
    chosen, basis = span(np.zeros((6, 6)))
    assert len(chosen) == 0
    assert basis.shape == (0, 6)

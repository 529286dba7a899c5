"""Clustered principal components: optimal for one cluster, never worse from round to round, stable in hard cases."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.compress.cpca import cpca
from relightcli.errors import NumericalError


def mixture(rng: np.random.Generator, clusters: int = 5, each: int = 60, size: int = 24) -> np.ndarray:
    parts = []
    for _ in range(clusters):
        plane = rng.standard_normal((2, size))
        parts.append(6.0 * rng.standard_normal(size) + rng.standard_normal((each, 2)) @ plane)
    return np.concatenate(parts)


def test_one_cluster_is_principal_component_analysis() -> None:
    x = np.random.default_rng(0).standard_normal((50, 8)) * np.arange(1, 9)
    found = cpca(x, 1, 3)
    values = np.linalg.svd(x - x.mean(0), compute_uv=False)
    assert found.count == 1
    np.testing.assert_allclose(found.residuals[-1], (values[3:] ** 2).sum(), rtol=1e-9)


def test_planes_are_found_and_the_residual_never_rises() -> None:
    x = mixture(np.random.default_rng(1))
    found = cpca(x, 5, 2)
    assert all(b <= a * (1 + 1e-9) for a, b in zip(found.residuals, found.residuals[1:], strict=False))
    assert found.residuals[-1] < 0.05 * found.norm2
    assert np.array_equal(found.label, cpca(x, 5, 2).label)


@pytest.mark.parametrize(
    "x",
    [
        np.zeros((7, 3)),
        np.ones((7, 3)),
        np.eye(3)[[0, 0, 1, 1, 2]],
        1e-30 * np.eye(4),
        1e12 * np.eye(4),
        np.ones((1, 5)),
    ],
    ids=["zero", "constant", "duplicates", "tiny", "large", "one row"],
)
def test_more_clusters_and_terms_than_the_data_have(x: np.ndarray) -> None:
    found = cpca(x, 9, 9)
    assert 1 <= found.count <= len(x)
    assert found.label.min() == 0
    assert found.label.max() == found.count - 1
    assert found.residuals[-1] <= 1e-9 * max(found.norm2, 1e-300)


def test_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(NumericalError):
        cpca(np.array([[0.0, np.nan], [1.0, 2.0]]), 2, 1)

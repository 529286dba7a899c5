"""Sums over clusters against dense float64 ones."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.shade.cluster_sum import ALL, NONE, Fractions, Lobes
from tests.core.brdf.reflectances import random_directions

M, N = 30, 300


def make(seed=0):
    """Fractions (M, N) in steps, normals, radii, and light of directions above all horizons where all see it."""
    rng = np.random.default_rng(seed)
    normal = random_directions(N, seed)
    normal[:128, 1] = np.abs(normal[:128, 1]) + 1.5  # the first two groups look up
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    steps = rng.choice(np.array([0, 255, 40, 200], np.uint8), (M, N))
    steps[:10, :128] = 255
    steps[10:20, 64:256] = 0
    d = random_directions(M, seed + 1)
    d[:10] = [0.0, 1.0, 0.0]
    flux = rng.random((M, 3)) * 10.0 ** rng.uniform(-2, 2, (M, 1))
    flux[20] = 0
    light = LeafLight(flux, flux[:, :, None] * d[:, None, :] * 0.999)
    return steps, normal, rng.uniform(0.02, 0.2, M), light


def columns(steps):
    return (steps[:, a : a + 128] for a in range(0, N, 128))


def dense(steps, normal, radius, light):
    height = np.einsum("kcx,nx->kcn", light.moment, normal.astype(np.float64))
    reach = (light.flux * radius[:, None])[..., None]
    low = np.maximum(height + reach, 0) ** 2 / np.maximum(4 * reach, 1e-300)
    return np.einsum("kn,kcn->nc", steps / 255.0, np.where(height >= reach, height, low))


@pytest.mark.parametrize("threads", [1, 3])
def test_sum(threads):
    steps, normal, radius, light = make()
    packed = Fractions(columns(steps), normal, radius)
    assert (packed.place == ALL).any()
    assert (packed.place == NONE).any()
    expected = dense(steps, normal, radius, light)
    found = packed.by_receiver(packed.sum(light, threads))
    np.testing.assert_array_equal(packed.by_receiver(packed.by_group(found)), found)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * expected.max())
    np.testing.assert_array_equal(packed.sum(light, threads), packed.sum(light, 1))
    for k in range(M):
        np.testing.assert_array_equal(packed.of(k), steps[k])


def test_change_is_the_difference_of_two_sums():
    steps, normal, radius, old = make()
    packed = Fractions(columns(steps), normal, radius)
    chosen = np.array([0, 3, 15, 20, 29])
    new = LeafLight(old.flux.copy(), old.moment.copy())
    new.flux[chosen] += 0.7
    new.moment[chosen] += 0.7 * np.array([0.0, 1.0, 0.0])
    expected = packed.sum(new, 1)
    for threads in (1, 2):
        found = packed.sum(old, 1)
        packed.change(found, chosen, old, new, threads)
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_a_sun_that_comes_and_goes_leaves_the_digits_of_a_faint_sky():
    steps, normal, radius, light = make()
    packed = Fractions(columns(steps), normal, radius)
    faint = LeafLight(light.flux * 1e-3, light.moment * 1e-3)
    sunny = LeafLight(faint.flux.copy(), faint.moment.copy())
    sunny.flux[7] += 1e6
    sunny.moment[7] += 1e6 * np.array([0.0, 1.0, 0.0])
    at = np.array([7])
    before = packed.sum(faint, 1)
    after = before.copy()
    packed.change(after, at, faint, sunny, 1)
    assert after.max() > 1e5
    packed.change(after, at, sunny, faint, 1)
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9 * before.max())


def test_lobes():
    rng = np.random.default_rng(3)
    steps = rng.integers(0, 256, (M, N)).astype(np.uint8)
    steps[:5] = 255
    steps[5:10, 64:128] = 0
    scale = rng.random((M, -(-N // 64))).astype(np.float32)
    chosen, flux = np.arange(2, M, 3), rng.random((10, 3))[: len(np.arange(2, M, 3))]
    found = Lobes(steps, scale).sum(chosen, flux, 2)
    expected = np.einsum("kn,kc->nc", (steps * np.repeat(scale.astype(np.float64), 64, axis=1)[:, :N])[chosen], flux)
    np.testing.assert_allclose(found, expected, rtol=1e-12)

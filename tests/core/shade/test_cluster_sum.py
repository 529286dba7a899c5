"""Sums over clusters against dense float64 ones."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.core.lights.leaf_light import LeafLight
from relightcli.core.shade.cluster_sum import ALIKE, ALL, NONE, Fractions, Lobes
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


def of(light, clusters):
    return LeafLight(light.flux[clusters], light.moment[clusters])


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
        packed.change(found, chosen, of(old, chosen), of(new, chosen), threads)
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_colours_from_one_place_share_their_cosine():
    steps, normal, radius, light = make()
    packed = Fractions(columns(steps), normal, radius)
    apart = light.flux[:, :, None] * np.array([[0.5, 0.5, 0.1], [-0.5, -0.5, 0.1], [0.0, 0.0, -0.4]])
    for size in (0.0, 0.8e-3, 3e-3):  # shared by all, by some, and taken colour by colour
        other = LeafLight(light.flux, light.moment + size * apart)
        alike = packed._flat(other, np.arange(M)).alike
        assert alike.all() if size < 1e-3 else not alike[light.flux[:, 0] > 0].any()
        error = np.abs(packed.by_receiver(packed.sum(other, 1)) - dense(steps, normal, radius, other))
        limit = ALIKE * light.flux.sum(axis=0) if 0.0 < size < 1e-3 else 1e-12 * light.flux.sum(axis=0)
        assert (error <= limit).all()


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
    packed.change(after, at, of(faint, at), of(sunny, at), 1)
    assert after.max() > 1e5
    packed.change(after, at, of(sunny, at), of(faint, at), 1)
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9 * before.max())


def shine(lobes, clusters, flux, threads):
    groups = lobes.dark()
    lobes.add(groups, clusters, flux, threads)
    return np.ascontiguousarray(groups.transpose(0, 2, 1)).reshape(-1, 3)[: lobes.count]


def test_lobes():
    rng = np.random.default_rng(3)
    steps = rng.integers(0, 256, (M, N)).astype(np.uint8)
    steps[:5] = 255
    steps[5:10, 64:128] = 0
    scale = rng.random((M, -(-N // 64))).astype(np.float32)
    chosen, flux = np.arange(2, M, 3), rng.random((10, 3))[: len(np.arange(2, M, 3))]
    lobes = Lobes(steps, scale)
    found = shine(lobes, chosen, flux, 2)
    expected = np.einsum("kn,kc->nc", (steps * np.repeat(scale.astype(np.float64), 64, axis=1)[:, :N])[chosen], flux)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    rows, more = np.sort(rng.permutation(2 * N)[:N]), -2.0 * expected * (rng.random((N, 3)) < 0.5)
    groups = lobes.dark()
    lobes.add(groups, chosen, flux, 1)
    placed = np.zeros((2 * N, 3))
    colour = rng.random((2 * N, 3)).astype(np.float32)
    placed[rows] = np.maximum(expected + more, 0.0) * colour[rows]
    np.testing.assert_allclose(lobes.put(groups, more, rows, colour), placed, rtol=1e-6, atol=1e-9 * placed.max())
    placed[rows] = expected * colour[rows]
    np.testing.assert_allclose(lobes.put(groups, None, rows, colour), placed, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 63, 64, 65, 300])
def test_receivers_fill_groups_or_do_not(count):
    steps, normal, radius, light = make(5)
    # A lone receiver must not make ALL of a group whose light stands below its horizon.
    steps[10:, count - 1] = np.minimum(steps[10:, count - 1], 200)
    packed = Fractions([steps[:, :count]], normal[:count], radius)
    found = packed.by_receiver(packed.sum(light, 1))
    expected = dense(steps[:, :count], normal[:count], radius, light)
    assert found.shape == (count, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * expected.max())


@pytest.mark.parametrize("run", [64, 128, 256, 320])
def test_runs_of_receivers_do_not_matter(run):
    steps, normal, radius, light = make(6)
    whole = Fractions([steps], normal, radius)
    packed = Fractions((steps[:, a : a + run] for a in range(0, N, run)), normal, radius)
    np.testing.assert_array_equal(packed.sum(light, 1), whole.sum(light, 1))
    for k in range(M):
        np.testing.assert_array_equal(packed.of(k), steps[k])


@pytest.mark.parametrize("chosen", [[0, 3, 15, 20, 29], list(range(M))])
def test_threads_change_the_same_bits(chosen):
    steps, normal, radius, old = make(7)
    packed = Fractions(columns(steps), normal, radius)
    chosen = np.array(chosen)
    new = LeafLight(old.flux * 1.7, old.moment * 1.7)
    one, three = packed.sum(old, 1), packed.sum(old, 3)
    np.testing.assert_array_equal(one, three)
    packed.change(one, chosen, of(old, chosen), of(new, chosen), 1)
    packed.change(three, chosen, of(old, chosen), of(new, chosen), 3)
    np.testing.assert_array_equal(one, three)
    picked = LeafLight(np.zeros_like(old.flux), np.zeros_like(old.moment))
    picked.flux[chosen], picked.moment[chosen] = 0.7 * old.flux[chosen], 0.7 * old.moment[chosen]
    expected = dense(steps, normal, radius, old) + dense(steps, normal, radius, picked)
    np.testing.assert_allclose(packed.by_receiver(one), expected, rtol=1e-12, atol=1e-12 * expected.max())


def test_a_cluster_may_lose_all_its_light_and_get_it_back():
    steps, normal, radius, light = make(8)
    packed = Fractions(columns(steps), normal, radius)
    dark = LeafLight(np.zeros_like(light.flux), np.zeros_like(light.moment))
    every = np.arange(M)
    out = packed.sum(light, 1)
    scale = out.max()
    packed.change(out, every, of(light, every), of(dark, every), 1)
    np.testing.assert_allclose(out, 0, atol=1e-12 * scale)
    packed.change(out, every, of(dark, every), of(light, every), 1)
    np.testing.assert_allclose(out, packed.sum(light, 1), atol=1e-12 * scale)
    assert not packed.sum(dark, 1).any()


def test_what_a_sun_leaves_behind_is_its_last_digit():
    # A sum that has been 1e6 is rounded to 1.2e-10: 1.2e-7 of a sky of 1e-3, and no less can be asked for.
    steps, normal, radius, light = make(9)
    packed = Fractions(columns(steps), normal, radius)
    faint = LeafLight(light.flux * 1e-3, light.moment * 1e-3)
    sunny = LeafLight(faint.flux.copy(), faint.moment.copy())
    sunny.flux[[7, 25]] += 1e6
    sunny.moment[[7, 25]] += 1e6 * np.array([0.0, 1.0, 0.0])
    before = packed.sum(faint, 1)
    after = before.copy()
    at = np.array([7, 25])
    for _ in range(10):
        packed.change(after, at, of(faint, at), of(sunny, at), 1)
        packed.change(after, at, of(sunny, at), of(faint, at), 1)
    assert np.abs(after - before).max() < 20 * np.spacing(2e6)


def test_lobes_of_full_empty_and_unscaled_groups():
    rng = np.random.default_rng(4)
    groups = -(-N // 64)
    steps = rng.integers(0, 256, (M, N)).astype(np.uint8)
    steps[:5] = 255
    steps[5:10] = 0
    steps[10:15, 64:192] = 0
    scale = rng.random((M, groups)).astype(np.float32)
    scale[15:20], scale[20:25, ::2] = 0, 0
    lobes = Lobes(steps, scale)
    assert (lobes.place != ALL).all()
    assert (lobes.place[:, 5:10] == NONE).all()
    transfer = steps * np.repeat(scale.astype(np.float64), 64, axis=1)[:, :N]
    flux = rng.random((M, 3)) * 10.0 ** rng.uniform(-3, 3, (M, 1))
    for chosen in (np.arange(M), np.array([29, 0, 7, 17]), np.arange(5, 10), np.zeros(0, np.int64)):
        expected = np.einsum("kn,kc->nc", transfer[chosen], flux[chosen])
        found = shine(lobes, chosen, flux[chosen], 1)
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        np.testing.assert_array_equal(shine(lobes, chosen, flux[chosen], 3), found)

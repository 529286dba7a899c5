"""Transfer vectors on demand against rays, and bits turned from receivers to texels."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from relightcli.adapters.rays import Tracer
from relightcli.core.sphere import cube
from relightcli.core.transport.light_vectors import LightVectors, surrounding_texels, transpose_bits
from relightcli.core.transport.visibility import horizon_bits, trace_visibility
from tests.core.brdf.reflectances import random_directions
from tests.core.transport.scenes import sphere_grid

RESOLUTION = 32


def unpack(words, count):
    return np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")[:, :count].astype(bool)


@pytest.fixture(scope="module")
def scene():
    """A ball above a floor: mesh, receivers on the floor and on the ball, their normals."""
    corners, triangles = sphere_grid(24, 48)
    floor = np.array([[-4, 0, -4], [-4, 0, 4], [4, 0, 4], [4, 0, -4]], float)
    mesh = np.concatenate([corners * 0.5 + [0, 0.8, 0], floor])
    faces = np.concatenate([triangles, np.array([[0, 1, 2], [0, 2, 3]]) + len(corners)]).astype(np.int32)
    x = np.linspace(-1.5, 1.5, 20)
    ground = np.array([[a, 0, b] for a in x for b in x])
    position = np.concatenate([ground, corners * 0.5 + [0, 0.8, 0]])
    normal = np.concatenate([np.tile([0.0, 1.0, 0.0], (len(ground), 1)), corners]).astype(np.float32)
    return Tracer(mesh, faces), position, normal


@pytest.fixture(scope="module")
def vectors(scene):
    tracer, position, normal = scene
    bits = trace_visibility(tracer, position, normal, RESOLUTION, 1, 0).bits
    base = np.zeros((6 * RESOLUTION**2, -(-len(position) // 64)), np.uint64)
    transpose_bits([(slice(0, len(position)), bits)], base)
    return LightVectors(base, position, normal, tracer)


@pytest.mark.parametrize("count", [1, 63, 64, 65, 700])
def test_bits_by_texel(count):
    rng = np.random.default_rng(count)
    bits = rng.integers(0, 256, (count, 6, 16, 2), np.uint8)
    out = np.zeros((6 * 256, -(-count // 64)), np.uint64)
    cuts = [0, min(count, 64), count]
    transpose_bits([(slice(a, b), bits[a:b]) for a, b in itertools.pairwise(cuts) if b > a], out)
    expected = np.unpackbits(bits.reshape(count, -1), axis=1, bitorder="little").T.astype(bool)
    np.testing.assert_array_equal(unpack(out, count), expected)
    assert unpack(out, 64 * out.shape[1])[:, count:].sum() == 0


def test_almost_what_rays_say_for_few_rays(scene, vectors):
    tracer, position, normal = scene
    directions = random_directions(300, 0)
    vectors.rays = 0
    found = unpack(vectors.visible(directions), len(position))
    assert 0 < vectors.rays < 0.1 * found.size
    expected = np.zeros_like(found)
    for row, d in zip(expected, directions.astype(np.float32), strict=True):
        up = np.flatnonzero(normal @ d > 0)
        row[up] = ~tracer.occluded(vectors.origin[up], np.tile(d, (len(up), 1)))
    assert (found != expected).mean() < 4e-4


def test_on_a_texel_the_stored_bit_and_no_ray(vectors):
    centres = cube.texel_directions(RESOLUTION).reshape(-1, 3)
    vectors.rays = 0
    np.testing.assert_array_equal(vectors.visible(centres), vectors.base)
    assert vectors.rays == 0


def test_without_a_tracer_the_horizon_alone(scene):
    _, position, normal = scene
    base = np.zeros((6 * RESOLUTION**2, -(-len(position) // 64)), np.uint64)
    transpose_bits([(slice(0, len(position)), horizon_bits(normal, RESOLUTION))], base)
    directions = random_directions(100, 1)
    found = unpack(LightVectors(base, position, normal, None).visible(directions), len(position))
    height = directions.astype(np.float32) @ normal.T
    sure = np.abs(height) > 1e-6
    np.testing.assert_array_equal(found[sure], height[sure] > 0)


def test_texels_around_a_direction_are_near_it_across_borders_too():
    edge = np.array([[1, 0.9999, 0.3], [1, 1.0001, 0.3], [1, 0.9999, 0.9998], [-1, -0.2, 0.99999], [0.3, -1, -0.9999]])
    directions = np.concatenate([random_directions(500, 2), edge / np.linalg.norm(edge, axis=1, keepdims=True)])
    centres = cube.texel_directions(RESOLUTION).reshape(-1, 3)
    around = surrounding_texels(directions, RESOLUTION)
    angle = np.arccos(np.clip(np.einsum("nkx,nx->nk", centres[around], directions), -1, 1))
    assert angle.max() < 2.3 * 2 / RESOLUTION
    assert (around == cube.texel_index(directions, RESOLUTION)[:, None]).any(axis=1).all()

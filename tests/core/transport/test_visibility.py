"""Visibility bits: against rays for every texel, and what refinement loses."""

import itertools
import math

import numpy as np
import pytest

from relightcli.adapters.meshes import load_mesh
from relightcli.adapters.rays import Tracer
from relightcli.core.sphere import cube
from relightcli.core.transport import visibility
from relightcli.core.transport.receivers import spatial_order
from relightcli.core.transport.visibility import horizon_bits, trace_visibility
from tests.core.brdf.reflectances import random_directions
from tests.core.transport.scenes import sphere_grid

UP = np.array([0, 1, 0], np.float32)


def count(bits):
    return int(np.bitwise_count(bits).sum(dtype=np.int64))


def unpack(bits):
    return np.unpackbits(bits, axis=-1, bitorder="little").astype(bool)


def merge(*meshes):
    start, positions, faces = 0, [], []
    for corners, triangles in meshes:
        positions.append(corners)
        faces.append(triangles + start)
        start += len(corners)
    return np.concatenate(positions).astype(np.float64), np.concatenate(faces).astype(np.int32)


GROUND = (np.array([[-4, 0, -4], [-4, 0, 4], [4, 0, 4], [4, 0, -4]], float), np.array([[0, 1, 2], [0, 2, 3]]))


def still_life(rings=24):
    """Two spheres over a ground: positions, faces; and receivers on the ground and on one sphere, sorted in space."""
    corners, triangles = sphere_grid(rings, 2 * rings)
    positions, faces = merge(
        GROUND, (corners * 0.5 + [0, 0.5, 0], triangles), (corners * 0.3 + [0.9, 0.4, 0], triangles)
    )
    x, z = np.meshgrid(np.linspace(-1.5, 1.5, 16), np.linspace(-1.5, 1.5, 16))
    ground = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], -1)
    keep = ground[:, 0] ** 2 + ground[:, 2] ** 2 > 1e-3
    points = np.concatenate([ground[keep], corners[::7] * 0.5 + [0, 0.5, 0]])
    normals = np.concatenate([np.tile(UP, (keep.sum(), 1)), corners[::7]]).astype(np.float32)
    order = spatial_order(points)
    return positions, faces, points[order], normals[order]


@pytest.fixture(scope="module")
def traced():
    positions, faces, points, normals = still_life()
    tracer = Tracer(positions, faces)
    return tracer, points, normals, trace_visibility(tracer, points, normals, 32, 1, 0)


def test_every_texel_against_its_ray(traced):
    tracer, points, normals, block = traced
    d = cube.texel_directions(32).reshape(-1, 3).astype(np.float32)
    for i in range(0, len(points), 23):
        above = d @ normals[i] > 0
        origin = tracer.offset(points[i : i + 1], normals[i : i + 1])
        blocked = tracer.occluded(np.repeat(origin, above.sum(), 0), np.ascontiguousarray(d[above]))
        expected = np.zeros(len(d), bool)
        expected[above] = ~blocked
        found = unpack(block.bits[i]).reshape(-1)
        # A texel centre on the horizon itself may fall either way by the rounding of the dot product.
        sure = np.abs(d @ normals[i]) > 1e-6
        np.testing.assert_array_equal(found[sure], expected[sure])
    assert (block.checked, block.wrong, block.inferred) == (0, 0, 0)
    assert block.rays == count(horizon_bits(normals, 32))


@pytest.mark.parametrize("refine", [1, 2, 4])
def test_no_ray_is_cast_twice(refine):
    positions, faces, points, normals = still_life()
    # The sphere's grid has several points at its seam, whose rays are the same.
    once = np.sort(np.unique(np.concatenate([points, normals], axis=1), axis=0, return_index=True)[1])
    points, normals = points[once][:96], normals[once][:96]
    tracer, rays = Tracer(positions, faces), []

    class Recorder:
        offset = staticmethod(tracer.offset)

        def occluded(self, origins, directions, max_distance=None):
            rays.append(np.concatenate([origins, directions], axis=1))
            return tracer.occluded(origins, directions, max_distance)

    block = trace_visibility(Recorder(), points, normals, 32, refine, 0)
    cast = np.concatenate(rays)
    assert len(cast) == block.rays
    different = len(np.unique(np.ascontiguousarray(cast).view("V24")))
    # Checks are drawn at random: from probes too, and some twice; one that is wrong is followed by its whole cell.
    assert len(cast) - different <= block.checked


@pytest.mark.parametrize("resolution", [16, 24, 40, 64])
def test_horizon_bits(resolution):
    normals = random_directions(20, 1).astype(np.float32)
    expected = np.einsum("fijx,nx->nfij", cube.texel_directions(resolution), normals.astype(np.float64))
    found = unpack(horizon_bits(normals, resolution))
    sure = np.abs(expected) > 1e-6
    np.testing.assert_array_equal(found[sure], (expected > 0)[sure])


@pytest.mark.parametrize("refine", [1, 2, 4])
def test_nothing_around_is_the_horizon(refine):
    normals = random_directions(20, 2).astype(np.float32)
    tracer = Tracer(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    block = trace_visibility(tracer, np.zeros((20, 3)), normals, 16, refine, 0)
    np.testing.assert_array_equal(block.bits, horizon_bits(normals, 16))
    assert block.wrong == 0


@pytest.mark.parametrize(("resolution", "refine"), [(24, 2), (24, 4), (40, 8)])
def test_resolutions_that_are_no_powers_of_two(resolution, refine):
    positions, faces, points, normals = still_life()
    tracer = Tracer(positions, faces)
    truth = trace_visibility(tracer, points[:64], normals[:64], resolution, 1, 0)
    block = trace_visibility(tracer, points[:64], normals[:64], resolution, refine, 0)
    # At 40 texels by cells of 8, five cells are all that a face has: measured 2e-4.
    assert count(block.bits ^ truth.bits) / truth.rays < 1e-3


@pytest.mark.parametrize("refine", [1, 2, 4])
def test_enclosed_receivers_see_nothing(refine):
    # A closed room seen from its middle: no ray leaks through the edges of its faces.
    corners, triangles = sphere_grid(16, 32)
    normals = random_directions(64, 3).astype(np.float32)
    points = 0.2 * random_directions(64, 4)
    block = trace_visibility(Tracer(corners, triangles.astype(np.int32)), points, normals, 32, refine, 0)
    assert not block.bits.any()


# Measured on this scene, in shares of the bits above the horizon: 3.0e-6, 1.4e-5, 9.3e-5.
@pytest.mark.parametrize(("refine", "bound"), [(2, 1e-5), (4, 4e-5), (8, 2e-4)])
def test_refinement_loses_few_bits(traced, refine, bound):
    tracer, points, normals, truth = traced
    block = trace_visibility(tracer, points, normals, 32, refine, 0)
    assert block.rays < truth.rays
    wrong = count(block.bits ^ truth.bits) / truth.rays
    assert wrong < bound
    # Nothing below the horizon is ever set.
    assert not (block.bits & ~horizon_bits(normals, 32)).any()


def test_bunny(shared_data):
    # Blocks of 64 vertices from six places of the mesh over a ground. Measured: 2.1e-5, 4.8e-5, 8.6e-5.
    mesh = load_mesh(shared_data / "meshes" / "stanford" / "bunny_zipper_full.ply")
    low, size = mesh.positions.min(axis=0), np.ptp(mesh.positions, axis=0).max()
    ground = GROUND[0] * size + [0, low[1], 0]
    tracer = Tracer(*merge((mesh.positions, mesh.faces), (ground, GROUND[1])))
    order = spatial_order(mesh.positions)
    rows = np.concatenate([order[a : a + 64] for a in np.linspace(0, len(order) - 64, 6).astype(int)])
    points, normals = mesh.positions[rows], mesh.normals[rows].astype(np.float32)
    truth = trace_visibility(tracer, points, normals, 64, 1, 0)
    for refine, bound in ((2, 8e-5), (4, 2e-4), (8, 4e-4)):
        block = trace_visibility(tracer, points, normals, 64, refine, 0)
        assert count(block.bits ^ truth.bits) / truth.rays < bound
        assert block.rays < 0.45 * truth.rays


def wire(width):
    """A long bar of that width, a unit above the ground, along x and off the grid's symmetry."""
    y, z, w = 1.0, 0.137, 0.5 * width
    corners = np.array([[x, y + a, z + b] for x in (-3, 3) for a, b in ((-w, -w), (-w, w), (w, w), (w, -w))], float)
    quads = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


# Probes at R = 64 lie refine/32 apart, 0.06 to 0.25 at the wire's distance, so that single receivers miss a wire half a
# texel wide (0.015); they share what they find. Measured shares of the wire's bits that are found:
# 0.987, 0.822, 0.563, 0.906, 0.980, 0.9997. The wire of 0.015 hides 54 texels of each receiver, 0.4 % of its sky.
@pytest.mark.parametrize(
    ("width", "refine", "found"),
    [(0.015, 2, 0.97), (0.015, 4, 0.79), (0.015, 8, 0.52), (0.03, 4, 0.88), (0.06, 4, 0.97), (0.12, 4, 0.999)],
)
def test_thin_occluder_is_found(width, refine, found):
    tracer = Tracer(*merge(GROUND, wire(width)))
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 16), np.linspace(-0.5, 0.5, 16))
    points = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], -1)
    points = points[spatial_order(points)]
    normals = np.tile(UP, (len(points), 1))
    truth = trace_visibility(tracer, points, normals, 64, 1, 0).bits
    bits = trace_visibility(tracer, points, normals, 64, refine, 0).bits
    hidden = count(horizon_bits(normals, 64) & ~truth)
    assert hidden > 10 * len(points)
    assert count(~bits & horizon_bits(normals, 64) & ~truth) / hidden > found


def test_reported_error_is_the_true_one(monkeypatch):
    # With mending off the sample's share of wrong bits estimates the true one; a wire makes them many.
    monkeypatch.setattr(visibility, "GROUP", 1)
    monkeypatch.setattr(visibility, "CHECKS", 256)
    tracer = Tracer(*merge(GROUND, wire(0.015)))
    rng = np.random.default_rng(5)
    points = np.stack([rng.uniform(-1, 1, 256), np.zeros(256), rng.uniform(-1, 1, 256)], -1)
    normals = np.tile(UP, (256, 1))
    truth = trace_visibility(tracer, points, normals, 64, 1, 0)
    block = trace_visibility(tracer, points, normals, 64, 8, 0)
    # What the check found was mended afterwards, with the neighbours of each cell: the estimate is of the state before,
    # so that the bits still wrong are fewer, but not by more than what a check of this density can mend.
    estimate = block.wrong / block.checked * block.inferred
    left = count(block.bits ^ truth.bits)
    assert block.wrong > 100
    assert left < estimate
    again = [trace_visibility(tracer, points, normals, 64, 8, seed) for seed in range(1, 9)]
    shares = [b.wrong / b.checked for b in [block, *again]]
    # Independent samples of about `wrong` finds agree to 1/sqrt(wrong); correlated ones scatter wider.
    expected = np.mean(shares) / math.sqrt(np.mean([b.wrong for b in again]))
    assert np.std(shares) < 2.5 * expected


def test_checks_of_different_receivers_are_different():
    n, resolution = 64, 16
    normals = np.tile(UP, (n, 1))
    tables = visibility._tables(resolution, 4)
    mark = np.zeros((n, len(tables.first_texel)), np.uint8)
    _, _, owner, texel = visibility._checks(
        np.zeros((n, 3), np.float32), normals, tables.directions, resolution, 4, mark, np.uint64(7), 16
    )
    # About half of 16 draws each are above the horizon, anywhere among 768 texels: two receivers in a row share a
    # texel by chance once in ten, and by a common sequence nearly always.
    chosen = [set(texel[owner == i].tolist()) for i in range(n)]
    shared = sum(len(a & b) for a, b in itertools.pairwise(chosen))
    assert len(owner) == pytest.approx(8 * n, abs=4 * math.sqrt(4 * n))
    assert shared < 0.3 * n


@pytest.mark.parametrize("seed", [-1, 2**63, 2**70])
def test_any_seed_will_do(traced, seed):
    tracer, points, normals, truth = traced
    block = trace_visibility(tracer, points[:32], normals[:32], 32, 4, seed)
    assert count(block.bits ^ truth.bits[:32]) / truth.rays < 1e-3


def test_the_same_seed_gives_the_same_bits(traced):
    tracer, points, normals, _ = traced
    a = trace_visibility(tracer, points, normals, 32, 4, 3)
    b = trace_visibility(tracer, points, normals, 32, 4, 3)
    np.testing.assert_array_equal(a.bits, b.bits)
    assert (a.rays, a.checked, a.wrong, a.inferred) == (b.rays, b.checked, b.wrong, b.inferred)


# Powers of two change nothing by construction. Other scales and places round the coordinates anew, so that a ray that
# passes an edge within 1e-7 of the scene's size may fall either way: measured none of 1.3 million, allowed ten.
@pytest.mark.parametrize(
    ("scale", "shift", "allowed"),
    [(2.0**-10, 0.0, 0), (2.0**20, 0.0, 0), (1e-4, 0.0, 10), (1e6, 0.0, 10), (1.0, 1e4, 10), (1e-4, 1.0, 10)],
)
@pytest.mark.parametrize("refine", [1, 4])
def test_scale_and_place_do_not_matter(traced, refine, scale, shift, allowed):
    tracer, points, normals, _ = traced
    positions, faces, _, _ = still_life()
    expected = trace_visibility(tracer, points, normals, 32, refine, 0)
    moved = Tracer(positions * scale + shift, faces)
    found = trace_visibility(moved, points * scale + shift, normals, 32, refine, 0)
    assert count(found.bits ^ expected.bits) <= allowed


def test_a_white_hemisphere_sums_to_one():
    # Furnace: sum of V cos dOmega / pi over an open hemisphere. Texel centres on one side of the horizon: the digest's
    # 8e-5 at R = 64 for an axis-aligned plane; tilted ones are better by the averaging along the horizon's staircase.
    normals = np.concatenate([np.eye(3), random_directions(20, 6)]).astype(np.float32)
    seen = unpack(horizon_bits(normals, 64))
    cosine = np.einsum("fijx,nx->nfij", cube.texel_directions(64), normals.astype(np.float64))
    total = np.einsum("nfij,ij->n", seen * cosine, cube.solid_angles(64)) / math.pi
    np.testing.assert_allclose(total, 1, atol=1.2e-4)

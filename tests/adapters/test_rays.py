"""Rays in packets against rays one by one, and both against spheres and squares known by heart."""

import gc

import numpy as np
import pytest

from relightcli.adapters import embree, rays
from relightcli.adapters.rays import SingleScene, Tracer
from relightcli.core.sphere import cube
from tests.core.brdf.reflectances import random_directions
from tests.core.transport.scenes import sphere_grid

SQUARE = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], float), np.array([[0, 2, 1], [0, 3, 2]], np.int32)


@pytest.fixture(params=["packets", "one by one"])
def build(request, monkeypatch):
    """Tracer, with the library and without; the library must be there, or the tests of it would be none."""
    assert embree.library() is not None
    if request.param == "one by one":
        monkeypatch.setattr(rays, "library", lambda: None)
    return Tracer


@pytest.fixture(scope="module")
def ball():
    corners, faces = sphere_grid(24, 48)
    return corners, faces.astype(np.int32)


def bundle(count, seed):
    """Origins outside the unit sphere, and where they look: some in fans from one point that it half fills, some
    anywhere."""
    fans = cube.texel_directions(16).reshape(-1, 3)[: count // 2 // 64 * 64]
    middle = fans.reshape(-1, 64, 3).mean(axis=1) + 0.3 * random_directions(len(fans) // 64, seed)
    starts = np.repeat(-1.6 * middle, 64, axis=0)
    loose = random_directions(count - len(fans), seed + 1)
    origins = np.concatenate([starts, 1.5 * random_directions(len(loose), seed + 2)])
    return origins.astype(np.float32), np.concatenate([fans, loose]).astype(np.float32)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 1000])
def test_packets_answer_as_single_rays(ball, count):
    loaded = embree.library()
    assert loaded is not None
    vertices = ball[0].astype(np.float32)
    packets, single = embree.PacketScene(loaded, vertices, ball[1]), SingleScene(vertices, ball[1])
    origins, directions = bundle(count, 5)
    far = np.random.default_rng(1).uniform(0.2, 3.0, count).astype(np.float32)
    for limit in (None, far):
        np.testing.assert_array_equal(
            packets.occluded(origins, directions, limit), single.occluded(origins, directions, limit)
        )
    # Bit by bit: a ray meets no edge of this ball so exactly that the face could be one or the other.
    for found, expected in zip(
        packets.intersect(origins, directions), single.intersect(origins, directions), strict=True
    ):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    if count == 1000:
        hit = packets.intersect(origins, directions)[0] >= 0
        assert 100 < hit.sum() < 900


def test_threads_answer_as_one(ball, build):
    one, two = build(*ball), build(*ball, 2)
    origins, directions = bundle(rays.MANY + 1, 9)
    far = np.random.default_rng(3).uniform(0.2, 3.0, len(origins)).astype(np.float32)
    for limit in (None, far):
        blocked = one.occluded(origins, directions, limit)
        assert 0 < blocked.sum() < len(blocked)
        np.testing.assert_array_equal(two.occluded(origins, directions, limit), blocked)
    found, expected = two.intersect(origins, directions), one.intersect(origins, directions)
    for name in ("face", "u", "v", "distance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_fan_is_coherent_and_rays_from_anywhere_are_not():
    packet = embree._scratch()
    valid = packet.view(np.int32)[embree._ROWS * embree.WIDTH :]
    fan = cube.texel_directions(16).reshape(6, 4, 4, 4, 4, 3).swapaxes(2, 3).reshape(-1, 16, 3).astype(np.float32)
    still = np.zeros((16, 3), np.float32)
    for cell in fan:  # as visibility asks for them: a cell of 4 x 4 texels, two packets
        assert embree._load(0, 16, still, cell, packet, valid)
        assert embree._load(8, 16, still, cell, packet, valid)
    assert embree._load(0, 5, still, fan[0], packet, valid)
    np.testing.assert_array_equal(valid[:8], [-1] * 5 + [0] * 3)
    moved = still.copy()
    moved[3, 1] = 1e-3
    assert not embree._load(0, 8, moved, fan[0], packet, valid)
    assert not embree._load(0, 8, still, -fan[0] * np.where(np.arange(16) == 2, 1, -1)[:, None], packet, valid)
    assert not embree._load(0, 8, still, random_directions(8, 3).astype(np.float32), packet, valid)


def test_a_square(build):
    # Seen from (0.25, 1, 0.5) straight down, from below, past it, and with an end before and behind it.
    tracer = build(*SQUARE)
    assert tracer.scale == 1.0
    origins = tracer.to_local(np.array([[0.25, 1, 0.5], [0.25, -2, 0.5], [3, 1, 0], [0.25, 1, 0.5]]))
    down = np.array([[0, -1, 0], [0, 1, 0], [0, -1, 0], [0, 1, 0]], np.float32)
    np.testing.assert_array_equal(tracer.occluded(origins, down), [True, True, False, False])
    ends = np.array([0.99, 2.01, 9, 9], np.float32)
    np.testing.assert_array_equal(tracer.occluded(origins, down, ends), [False, True, False, False])
    hits = tracer.intersect(origins, down)
    corners = SQUARE[0][SQUARE[1]]
    for k, distance in ((0, 1.0), (1, 2.0)):
        a, b, c = corners[hits.face[k]]
        point = a + hits.u[k] * (b - a) + hits.v[k] * (c - a)
        np.testing.assert_allclose(point, [0.25, 0, 0.5], atol=1e-6)  # float32
        assert hits.distance[k] == pytest.approx(distance, rel=1e-6)
    np.testing.assert_array_equal(hits.face[2:], -1)
    np.testing.assert_array_equal(hits.u[2:], 0)
    assert (hits.distance[2:] > 1e30).all()


def test_nothing_there(build):
    tracer = build(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    origins, directions = bundle(64, 1)
    assert not tracer.occluded(origins, directions).any()
    assert (tracer.intersect(origins, directions).face == -1).all()
    there = build(*SQUARE)
    assert there.occluded(origins[:0], directions[:0]).shape == (0,)
    assert there.intersect(origins[:0], directions[:0]).face.shape == (0,)


def test_views_and_other_types_are_taken(ball):
    tracer = Tracer(*ball)
    origins, directions = bundle(200, 9)
    expected = tracer.occluded(origins, directions)
    assert 0 < expected.sum() < 200
    np.testing.assert_array_equal(tracer.occluded(origins[::-1], directions[::-1]), expected[::-1])
    np.testing.assert_array_equal(tracer.occluded(origins.astype(np.float64), directions), expected)


@pytest.mark.parametrize(
    ("origins", "directions", "far"),
    [((4, 3), (3, 3), None), ((4, 2), (4, 2), None), ((4, 3), (4, 3), 3)],
)
def test_rays_of_another_shape_are_refused(origins, directions, far):
    limit = None if far is None else np.ones(far, np.float32)
    with pytest.raises(ValueError, match="expected"):
        Tracer(*SQUARE).occluded(np.ones(origins, np.float32), np.ones(directions, np.float32), limit)


def test_scenes_are_given_back(ball, monkeypatch):
    released = []
    monkeypatch.setattr(embree, "_release", lambda library, scene, *_: released.append(scene))
    tracer = Tracer(*ball)
    scene = tracer._scene._scene
    del tracer
    gc.collect()
    assert released == [scene]


def test_a_device_that_fails_is_a_fault_of_the_system(monkeypatch):
    loaded, device = embree.library()

    class Failing:
        def __getattr__(self, name):
            return (lambda _: 4) if name == "rtcGetDeviceError" else getattr(loaded, name)

    from relightcli.errors import SystemFault

    with pytest.raises(SystemFault, match="2 faces"):
        embree.PacketScene((Failing(), device), SQUARE[0].astype(np.float32), SQUARE[1])

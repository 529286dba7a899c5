"""The peers that are written here, and what they are given: they must not lose because they are wrong."""

import numpy as np
import pytest

from benchmarks import mitsuba, sky_matrix, tensors, wavelets
from benchmarks.receivers import Traceable, sample, share
from benchmarks.scenes import BUNNY_VERTICES, Setting, write_scene
from benchmarks.sh_transfer import ORDER, our_transfer, script_transfer

# Two points that look up from far below the edge of a wall; the wall covers the half of their sky with x > 0.
WALL = Traceable(
    np.array([[0.01, -50, -100], [0.01, 50, -100], [0.01, 50, 100], [0.01, -50, 100.0]]) * 10,
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    np.zeros((2, 3)),
    np.array([[0, 1, 0], [0, 1, 0]], np.float32),
)


def test_the_script_converges_to_the_open_half_of_the_sky():
    # Half of a clamped cosine: (1/pi) integral of cos y_0 over the half dome = y_0 / 2, y_0 = 1 / sqrt(4 pi).
    _, transfer = script_transfer(WALL, 1 << 15, 1)
    y0 = 1 / np.sqrt(4 * np.pi)
    # Standard error: sqrt(E[f^2] - E[f]^2) / sqrt(n) with f = 4 cos V y_0: 4 y_0 sqrt(1/12 - 1/64) / 181 = 0.0016.
    np.testing.assert_allclose(transfer[:, 0], y0 / 2, atol=5 * 0.0016)
    # y_3 = sqrt(3 / 4 pi) x: (1/pi) integral of y x over the quarter y > 0, x < 0 is -2 / (3 pi). Its f is at most as
    # large as that of y_0 times sqrt(3).
    np.testing.assert_allclose(transfer[:, 3], -np.sqrt(3 / (4 * np.pi)) * 2 / (3 * np.pi), atol=5 * 0.0028)


def test_the_script_and_ours_agree(monkeypatch):
    monkeypatch.setattr("benchmarks.sh_transfer.meet", lambda: None)
    _, expected = script_transfer(WALL, 1 << 15, 2)
    _, rays, parts = our_transfer(0, 1, WALL, 64, 1)
    assert rays > 0
    ours = np.concatenate([values for _, values in parts])
    assert ours.shape == expected.shape == (2, ORDER**2)
    # Five standard errors of the script, each at most 4 max|y| sqrt(1/12) / sqrt(2^15), |y| <= 1.1 for l <= 2.
    np.testing.assert_allclose(ours, expected, atol=5 * 0.007)


def test_patches():
    counts, alpha = sky_matrix.patch_rows()
    assert 1 + counts.sum() == sky_matrix.PATCHES == len(sky_matrix.overcast())
    assert len(counts) == 29
    # The middle of every patch, by rows from the horizon up, from north over east; and the ground.
    expected = 1
    for row, n in enumerate(counts):
        altitude, azimuth = (row + 0.5) * alpha, 2 * np.pi * np.arange(n) / n
        if n == 1:
            altitude = np.pi / 2
        flat = np.cos(altitude)
        d = np.stack([flat * np.sin(azimuth), np.full(n, np.sin(altitude)), -flat * np.cos(azimuth)], axis=1)
        np.testing.assert_array_equal(sky_matrix.patch_of(d), expected + np.arange(n))
        expected += n
    assert sky_matrix.patch_of(np.array([[0.6, -0.8, 0.0]])) == 0


def test_a_sensor_under_an_open_sky(monkeypatch):
    monkeypatch.setattr("benchmarks.sky_matrix.meet", lambda: None)
    below = Traceable(WALL.mesh - [0, 2e4, 0], WALL.faces, WALL.position, WALL.normal)
    found = sky_matrix.collect([sky_matrix.our_matrix(0, 1, below, 32, 1, np.array([1]))], 2)
    assert found.rays == 2 * 3072
    # E = integral of (1 + 2 sin a) / 3 cos over the dome = 7 pi / 9; rows of 3 degrees and texels of 3 degrees: 1e-3.
    np.testing.assert_allclose(found.irradiance, 7 * np.pi / 9, rtol=1e-3)
    # The rows of the matrix are those asked for, and a row under the sky is its irradiance.
    assert found.entries.shape == (1, sky_matrix.PATCHES)
    assert found.entries[0].astype(float) @ sky_matrix.overcast() == pytest.approx(found.irradiance[1], rel=1e-6)


def test_map_for_bilinear_look_up():
    sky = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    rows = mitsuba.bilinear_map(sky)
    assert rows.shape == (5, 8, 3)
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_array_equal(rows[1, ::2], sky[0])
    np.testing.assert_array_equal(rows[2, 1::2], 0.5 * (sky[0] + sky[1]))
    np.testing.assert_array_equal(rows[4, ::2], sky[1])


def test_time_at_an_error():
    found = {"error_at_one": 0.4, "seconds_fixed": 0.1, "seconds_per_sample": 0.01}
    assert mitsuba.seconds_at(found, 0.02) == 0.1 + 400 * 0.01
    assert mitsuba.seconds_at(found, 10.0) == 0.1 + 0.01  # no less than one sample


def test_the_slow_variant_meets_no_target():
    assert mitsuba.against_mitsuba("w", 0.1, "", 101.0, "llvm_ad_rgb").met
    assert not mitsuba.against_mitsuba("w", 0.1, "", 99.0, "llvm_ad_rgb").met
    assert mitsuba.against_mitsuba("w", 0.1, "", 1000.0, "scalar_rgb").met is None


def test_samples_and_shares_cover():
    assert len(sample(100, 1000)) == 100
    rows = sample(10_000, 640)
    assert len(rows) == 640
    assert rows[-1] == 9_999
    parts = [part for rank in range(3) for part in share(5000, rank, 3)]
    assert sorted(i for part in parts for i in range(part.start, part.stop)) == list(range(5000))


def test_the_knot_has_as_many_vertices_as_the_bunny(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIGHT_SHARED_DATA", str(tmp_path / "absent"))
    scene, subject = write_scene(Setting(tmp_path, False))
    assert f"{BUNNY_VERTICES:,} vertices" in subject
    assert (scene.parent / "knot.ply").exists()


def test_tensorly_errs_as_ours_does():
    pytest.importorskip("tensorly")
    from relightcli.core.compress.tucker import hooi

    rng = np.random.default_rng(4)
    # Falling spectra in all modes: as a random tensor has none to find.
    x = np.einsum("ai,bi,ci,i->abc", *(rng.standard_normal((n, 8)) for n in (20, 15, 12)), 2.0 ** -np.arange(8))
    for ranks in ((4, None, 5), (3, 4, 4)):
        _, theirs = tensors.tensorly_error(x, ranks)
        ours = tensors.lacking(x, hooi(x, ranks).core)
        # Both stop when the error stands still: tensorly at 1e-4 of it.
        assert ours == pytest.approx(theirs, abs=2e-4)
        assert 0.005 < ours < 0.5


def test_what_a_core_lacks():
    x = np.zeros((2, 2, 2))
    x[0, 0, 0], x[1, 1, 1] = 4.0, 3.0
    assert tensors.lacking(x, x[:1, :1, :1]) == pytest.approx(0.6)  # 3 of the 5 that its norm is
    assert tensors.lacking(x, x) == 0.0


def test_pywavelets_has_our_coefficients():
    pytest.importorskip("pywt")
    from relightcli.core.sphere import cube, haar
    from relightcli.core.transport.visibility import horizon_bits

    faces = np.random.default_rng(3).standard_normal((3, 16, 16))
    # Orthonormal sums of 256 numbers of size 1: round-off of 16 epsilon at most.
    np.testing.assert_allclose(wavelets.as_array(wavelets.forward_peer(faces)), haar.forward(faces), atol=1e-14)
    normals = np.array([[0, 1, 0], [0.6, 0.8, 0], [0, 0.6, -0.8]], np.float32)
    directions = cube.texel_directions(16).reshape(-1, 3).astype(np.float32)
    solid_angle = cube.solid_angles(16).astype(np.float32).reshape(-1)
    given = (horizon_bits(normals, 16), normals, directions, solid_angle, 20)
    _, theirs = wavelets.strongest_peer(*given)
    _, ours, _ = haar.truncated_cosine_transfer(*given)
    # Ties may be resolved either way, so that values are compared by size. float32 sums of values below 0.2.
    np.testing.assert_allclose(np.sort(np.abs(ours)), np.sort(np.abs(theirs)), atol=1e-6)

"""Daylight: the model's own formulas by hand, symmetry, and energies that do not depend on the resolution."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from relightcli.core.lights import sky, sun
from relightcli.core.lights.sky import sky_latlong, sun_shares
from relightcli.errors import InputError

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def texels(height, width):
    """Exact solid angles (H, 1) and integrals of sin(latitude) over the texel (H, 1)."""
    edges = math.pi * (0.5 - np.arange(height + 1) / height)
    solid = 2 * math.pi / width * -np.diff(np.sin(edges))
    cosine = 2 * math.pi / width * 0.5 * -np.diff(np.sin(edges) ** 2)
    return solid[:, None], cosine[:, None]


def test_zenith_luminance_by_hand():
    # T = 2, sun at the zenith: chi = (4/9 - 1/60) pi = 1.343904 rad, tan chi = 4.33148; (8.0906 - 4.9710) 4.33148
    # - 0.4310 + 2.4192 = 15.5007. Sun on the horizon: chi = 0, so only 2.4192 - 0.2155 T is left.
    assert_allclose(sky.zenith_luminance(math.pi / 2, 2), 15.5007, rtol=1e-4)
    assert_allclose(sky.zenith_luminance(0, 2), 2.4192 - 2 * 0.2155, rtol=1e-12)


def test_clear_sky_has_the_zenith_luminance_at_the_zenith():
    for elevation, turbidity in ((0.2, 2.0), (0.8, 3.0), (1.3, 6.0)):
        rgb = sky.clear_sky(np.array(1.0), np.array(math.pi / 2 - elevation), elevation, turbidity)
        # The RGB matrix has four digits.
        assert_allclose(rgb @ LUMINANCE, sky.zenith_luminance(elevation, turbidity), rtol=2e-4)


def test_perez_by_hand():
    # A = C = 1, B = -1, D = -2, E = 0.5, theta = 60 degrees, gamma = 90 degrees.
    expected = (1 + math.exp(-2)) * (1 + math.exp(-math.pi))
    assert_allclose(
        sky.perez(np.array(0.5), np.array(math.pi / 2), np.array([1, -1, 1, -2, 0.5])), expected, rtol=1e-12
    )


@pytest.mark.parametrize("elevation", [0, 20, 85, 90])
def test_mirror_symmetric_about_the_sun(elevation):
    # Azimuth 0 lies on the border between the two middle columns: the picture is its own mirror image. float32.
    picture = sky_latlong(elevation, 0, 3, (32, 64))
    assert_allclose(picture, picture[:, ::-1], rtol=1e-5)


def test_azimuth_turns_towards_plus_x():
    # Longitude = pi (1 - 2x): the sun at 90 degrees stands a quarter of the picture left of the middle.
    size = (90, 180)
    picture = sky_latlong(30, 91, 3, size)
    row, column = np.unravel_index(np.argmax(picture[..., 1]), size)
    assert column == math.floor((0.5 - 91 / 360) * 180)
    assert row == 29  # 30 degrees is the border of rows 29 and 30 (2 degrees each); the upper half is not darker
    assert_allclose(np.roll(sky_latlong(30, 1, 3, size), -45, axis=1), picture, rtol=1e-5)


@pytest.mark.parametrize("size", [(8, 16), (63, 127), (512, 1024), (2048, 4096)])
def test_sun_energy_does_not_depend_on_resolution(size):
    shares = sun_shares(math.radians(40), 1.0, size)
    assert_allclose(shares.sum(), 1, rtol=1e-12)


def test_sun_shares_lie_around_the_sun():
    height, width = size = (2048, 4096)
    elevation, azimuth = math.radians(52.3), math.radians(-110.7)
    shares = sun_shares(elevation, azimuth, size)
    row, column = np.nonzero(shares)
    latitude = math.pi * (0.5 - (row + 0.5) / height)
    longitude = math.pi * (1 - 2 * (column + 0.5) / width)
    texel = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], axis=1
    )
    axis = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
    )
    # A texel that the disc touches has its centre within the radius and half a diagonal of it.
    half_diagonal = 0.5 * math.hypot(1, 1) * math.pi / height
    assert np.arccos(texel @ axis).max() < sun.ANGULAR_RADIUS + half_diagonal
    # The mean direction is the axis, shortened by cos of points in the cap; a tenth of a texel is 1.5e-4.
    mean = shares[row, column] @ texel
    assert_allclose(mean / np.linalg.norm(mean), axis, atol=1.5e-4)
    # Inside the disc every texel has its own solid angle as share.
    solid = texels(height, width)[0]
    full = shares.max() / (solid[row[np.argmax(shares[row, column])], 0] / sun.SOLID_ANGLE)
    # 8 sample rows per diameter of a texel: 64 samples, whose count at the border is off by some tenth.
    assert_allclose(full, 1, atol=0.3)


def test_half_the_sun_sets():
    # At elevation 0 the horizon halves the disc; the sample rows are symmetric about it.
    assert_allclose(sun_shares(0.0, 0.3, (64, 128)).sum(), 0.5, rtol=1e-12)
    assert np.all(sun_shares(0.0, 0.3, (64, 128))[32:] == 0)


def test_sun_irradiance_arrives_in_the_map():
    elevation = math.radians(50)
    expected = sun.sun_radiance(elevation, 3) * sun.SOLID_ANGLE / sky.UNIT
    for size in ((64, 128), (512, 1024)):
        solid = texels(*size)[0]
        with_sun = sky_latlong(50, 20, 3, size, ground=(0, 0, 0)).astype(np.float64)
        shares = sun_shares(elevation, math.radians(20), size)
        added = (with_sun * solid[..., None])[shares > 0].sum(axis=0)
        # The sky behind the sun's few texels, at most 5 units over 1.1 texels' 0.0024 sr, is 0.1 % of the sun's 10.
        assert_allclose(added, expected, rtol=0.005 if size[0] == 64 else 0.001)


def test_sunlight_is_plausible_and_reddens():
    # The sun's illuminance outside the atmosphere is 128 klx to 134 klx; through clean air 90 to 110 remain at noon.
    noon = sun.sun_radiance(math.pi / 2, 2) * sun.SOLID_ANGLE
    assert 90 < noon @ LUMINANCE < 110
    low = sun.sun_radiance(math.radians(5), 2)
    assert low[2] / low[0] < 0.25 * noon[2] / noon[0]
    assert np.all(np.diff([sun.sun_radiance(math.radians(e), 3)[1] for e in range(0, 91, 5)]) > 0)


def test_extraterrestrial_table():
    xyz = 683 * 10 * sun._colour_matching(sun._WAVELENGTHS).T @ sun._EXTRATERRESTRIAL
    # The sun's luminance above the atmosphere is about 1.9e9 to 2.0e9 cd/m^2 (128 to 134 klx over its solid angle).
    assert 1.85e9 < xyz[1] < 2.05e9


def test_overcast_zenith_is_three_times_the_horizon():
    picture = sky_latlong(40, 0, size=(512, 4), overcast=True, ground=(0, 0, 0))
    # Texel centres lie half a row (0.18 degrees) off zenith and horizon: 2 sin(0.18 degrees) = 0.6 % at the horizon.
    assert_allclose(picture[0] / picture[255], 3, rtol=0.007)
    assert_array_equal(picture[256:], 0)
    assert_array_equal(picture[..., 0], picture[..., 2])


def test_overcast_illuminance():
    picture = sky_latlong(30, 0, size=(512, 4), overcast=True, ground=(0, 0, 0)).astype(np.float64)
    cosine = texels(512, 4)[1]
    # 0.3 + 21 sin 30 degrees = 10.8 klx; the midpoint rule over 256 rows is good to 1e-5.
    assert_allclose((picture[:256, :, 1] * cosine[:256]).sum() * sky.UNIT, 10.8, rtol=1e-4)


@pytest.mark.parametrize("overcast", [False, True])
def test_ground_reflects_the_upper_half(overcast):
    albedo = (0.5, 0.25, 0.0)
    for height in (64, 63):  # with an odd height the middle row is half ground
        picture = sky_latlong(35, 0, 3, (height, 2 * height), overcast, albedo).astype(np.float64)
        cosine = texels(height, 2 * height)[1]
        irradiance = (picture[: height // 2] * cosine[: height // 2, :, None]).sum(axis=(0, 1))
        # The middle row of an odd height adds its grazing half, cos at most 0.025 over a row of 64.
        assert_allclose(picture[-1, 0], albedo * irradiance / math.pi, rtol=1e-5 if height == 64 else 2e-3)


def test_finite_and_not_negative_over_the_whole_range():
    for turbidity in np.linspace(2, 10, 9):
        for elevation in np.linspace(0, 90, 19):
            picture = sky_latlong(elevation, 0, turbidity, (16, 32))
            assert np.isfinite(picture).all()
            assert picture.min() >= 0
            assert (picture[:8] @ LUMINANCE).min() > 0


def test_one_texel_map():
    picture = sky_latlong(45, 0, 3, (1, 1))
    assert picture.shape == (1, 1, 3)
    assert np.isfinite(picture).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1, 0), "sun elevation is -1"),
        ((float("nan"), 0), "sun elevation is nan"),
        ((30, float("inf")), "azimuth"),
        ((30, 0, 1.5), "turbidity is 1.5; expected 2"),
        ((30, 0, 3, (0, 4)), "size"),
        ((30, 0, 3, (2, 4), False, (2, 0, 0)), "albedo"),
    ],
)
def test_values_outside_the_model_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        sky_latlong(*arguments)

"""The brightest texels of a sky apart: nothing is lost, nothing is taken where nothing stands out, light is exact."""

import numpy as np
import pytest

from relightcli.core.brdf.models import SPECULAR, evaluate_many, pack_materials
from relightcli.core.lights.environment import latlong_to_cube, splat
from relightcli.core.shade.bright import COUNT, add_highlights, add_irradiance, split_bright
from relightcli.core.shade.irradiance import irradiance, moment_prefix
from relightcli.scene.model import Material

R = 16


def sunny():
    sky = np.random.default_rng(0).random((32, 64, 3)) * 0.2
    sky[7, 20] = [4e4, 3e4, 2e4]
    sky[9, 50] = 50.0
    return splat(latlong_to_cube(sky.astype(np.float32), R))


def test_both_parts_are_the_sky():
    sky = sunny()
    rest, bright = split_bright(sky)
    assert 0 < len(bright.texel) <= COUNT
    flux, moment = rest.flux.copy(), rest.moment.copy()
    flux[bright.texel] += bright.flux
    moment[bright.texel] += bright.moment
    np.testing.assert_allclose(flux, sky.flux, rtol=1e-12)
    np.testing.assert_allclose(moment, sky.moment, rtol=1e-12, atol=1e-15)
    assert rest.radiance().max() < 1e-3 * sky.radiance().max()
    assert rest.flux.min() >= 0.0


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_an_even_sky_is_left_alone(value):
    sky = latlong_to_cube(np.full((8, 16, 3), value, np.float32), R)
    rest, bright = split_bright(sky)
    assert rest is sky
    assert len(bright.texel) == 0


def receivers():
    rng = np.random.default_rng(1)
    bits = rng.integers(0, 256, (40, 6, R, R // 8), np.uint8)
    normals, views = rng.standard_normal((2, 40, 3)).astype(np.float32)
    for d in (normals, views):
        d /= np.linalg.norm(d, axis=1, keepdims=True)
    return bits, normals, views


def test_irradiance_is_that_of_the_whole_sky():
    bits, normals, _ = receivers()
    sky = sunny()
    rest, bright = split_bright(sky)
    even = irradiance(bits, normals, moment_prefix(rest)) / np.float32(np.pi)
    add_irradiance(bits, normals, bright, even, 2)
    whole = irradiance(bits, normals, moment_prefix(sky)) / np.pi
    # Texels on the horizon are cut off one by one here, and in the sum there.
    np.testing.assert_allclose(even, whole, rtol=1e-3, atol=1e-3 * whole.max())


def test_highlights_are_the_sum_over_visible_texels():
    bits, normals, views = receivers()
    _, bright = split_bright(sunny())
    table = pack_materials([Material("m", "cook-torrance", (0, 0, 0), (0.5, 0.4, 0.3), f0=0.8, roughness=0.3)])
    colour = table.parameters[0, SPECULAR : SPECULAR + 3].astype(np.float32)
    out = np.zeros((40, 3), np.float32)
    rows = np.arange(1, 40, 2)
    add_highlights(bits, rows, views, normals, bright, int(table.model[0]), table.parameters[0], colour, out, 2)
    seen = np.unpackbits(bits.reshape(40, -1), axis=1, bitorder="little")[:, bright.texel].astype(float)
    lobe = evaluate_many(
        table, 0, np.zeros(3), normals[:, None].astype(float), bright.direction, views[:, None].astype(float)
    )
    expected = np.einsum("nk,nkc,kc->nc", seen, lobe, bright.flux)
    expected[::2] = 0.0
    assert expected.max() > 0.0
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-6 * expected.max())

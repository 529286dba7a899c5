"""Measured materials from `--set` to the picture: the same as their numbers in the scene file, and path-traced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relightcli.core.brdf.measured import fits
from relightcli.core.measure.errors import relative_rmse
from relightcli.scene.model import Camera, Material
from relightcli.stages.relight import Config, relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, picture, read_layers, write_scene

CAMERA = Camera("main", (0.4, 1.6, 3), (0, 0.35, 0), fov=36, size=(48, 36))
PARTS = {
    "ground": square(3, material=lambert((0.5, 0.4, 0.3))),
    "ball": sphere(0.5, (0, 0.55, 0), rings=20, material=lambert((0.2, 0.5, 0.7))),
}
FITS = {fit.name: fit for fit in fits()}


def store_of(folder, parts, **settings):
    scene = write_scene(folder, parts, [CAMERA], {"smooth": smooth_map()}, adjustable=True)
    return make_store(scene, light_resolution=32, workers=2, **settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return store_of(tmp_path_factory.mktemp("plain"), PARTS)


def with_numbers(folder, name):
    fit = FITS[name]
    ball = Material("m", "cook-torrance", fit.diffuse, fit.specular, f0=fit.f0, roughness=fit.roughness)
    return store_of(folder, {**PARTS, "ball": replace(PARTS["ball"], material=ball)})


# One of the widest lobes and one of the narrowest, which takes another path through the code.
@pytest.mark.parametrize("name", ["gold-paint", "chrome"])
def test_a_name_is_its_numbers_written_out(store, tmp_path, name):
    written = with_numbers(tmp_path, name)
    for settings in ({}, {"reference": True, "spp": 16, "bounces": 1}):
        plain, _ = picture(store, "plain.exr", **settings)
        named, _ = picture(store, "named.exr", settings=(f"ball={name}",), **settings)
        truth, _ = picture(written, "truth.exr", **settings)
        np.testing.assert_array_equal(named, truth)
        assert relative_rmse(plain, named) > 0.1


@pytest.mark.parametrize("name", ["gold-paint", "colonial-maple-223"])
def test_against_the_path_tracer(store, name):
    # 2 % relative RMS is promised under a smooth sky; the path tracer's variance is known and taken off. The second
    # has a specular colour above 1, which both must take as it is.
    settings = (f"ball={name}", "ground=white-paint")
    ours, _ = picture(store, f"{name}.exr", settings=settings)
    picture(store, f"{name}-reference.exr", settings=settings, reference=True, spp=256, workers=2)
    layers = read_layers(store.parent / f"{name}-reference.exr")
    noise = np.sqrt(layers["variance"].mean() / (layers[""] ** 2).mean())
    assert noise < 0.02
    assert relative_rmse(ours, layers[""]) ** 2 - noise**2 < 0.02**2


def test_keyframes_step_from_one_to_the_next(store, tmp_path):
    (tmp_path / "shots.toml").write_text(
        "format = 1\nframes = 3\n"
        "[[key]]\nframe = 1\nset = { ball = 'gold-paint', 'ball.roughness' = 0.2 }\n"
        "[[key]]\nframe = 3\nset = { ball = 'chrome', 'ball.roughness' = 0.4 }\n"
    )
    relight(
        Config(
            store=store, output=str(tmp_path / "out.#.exr"), frames=tmp_path / "shots.toml", env="smooth", quiet=True
        )
    )
    for number, name, roughness in ((1, "gold-paint", 0.2), (2, "gold-paint", 0.3), (3, "chrome", 0.4)):
        single, _ = picture(store, "single.exr", settings=(f"ball={name}", f"ball.roughness={roughness}"))
        # 0.3 between the keys is 0.5 x 0.2 + 0.5 x 0.4, which differs from 0.3 by a rounding.
        np.testing.assert_allclose(read_layers(tmp_path / f"out.{number}.exr")[""], single, rtol=1e-5, atol=1e-6)

"""Pixels of a camera that gather the light of vertices: against the vertices, the path tracer, and themselves."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.measure.errors import relative_rmse
from relightcli.errors import StoreError
from relightcli.run import blocks as run
from relightcli.scene.model import Camera, Material
from relightcli.stages import check_cost, lighting, visibility_job
from relightcli.stages import precompute as stage
from relightcli.stages.lighting import LightingStore
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, read_layers, write_scene
from tests.stages.test_bounces import GOLD, LAMP, corner, layers_of
from tests.stages.test_precompute import Stopping, array_bytes

CAMERA = Camera("main", (0.4, 1.3, 2.6), (0, 0.4, 0), fov=38, size=(40, 30))
OTHER = Camera("other", (-0.4, 1.3, 2.6), (0, 0.4, 0), fov=38, size=(8, 6))
LAYERS = ("direct", "specular", "one_bounce", "two_bounce")
PIXELS = "pixels:main"
COARSE = {"light_resolution": 16, "refine": 2, "bounce_resolution": 8}
EDIT = ("ground.diffuse=0.2,0.6,0.3", "ball.diffuse=0.8,0.8,0.7", "gold.roughness=0.5", "gold.specular=0.5,0.7,0.9")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    tiles = np.kron(np.array([[0, 1], [1, 0]]), np.ones((4, 4)))[..., None] * [0.8, 0.3, 0.2] + 0.1
    sheet = square(0.8, 0.9, material=Material("m", "blinn-phong", (0.3, 0.4, 0.5), (0.2, 0.2, 0.2), shininess=20))
    sheet.two_sided = True
    parts = {
        "ground": square(3, material=lambert((0.6, 0.5, 0.4))),
        "wall": corner(lambert(1.0), tiles),
        "ball": sphere(0.4, (-0.5, 0.42, 0), rings=16, material=lambert((0.2, 0.5, 0.7))),
        "gold": sphere(0.35, (0.45, 0.36, 0.1), rings=16, material=GOLD),
        "sheet": sheet,
    }
    folder = tmp_path_factory.mktemp("scene")
    sky = smooth_map()
    return write_scene(folder, parts, [CAMERA, OTHER], {"smooth": sky}, adjustable=True, more=LAMP)


@pytest.fixture(scope="module")
def vertices(scene):
    return make_store(scene, "vertices.zarr", bounces=2, light_resolution=32)


@pytest.fixture(scope="module")
def pixels(scene):
    return make_store(scene, "pixels.zarr", bounces=2, light_resolution=32, receivers=PIXELS)


@pytest.mark.parametrize("edit", [pytest.param((), marks=pytest.mark.slow), EDIT], ids=["as it is", "edited"])
def test_layers_against_vertices_and_the_path_tracer(vertices, pixels, edit):
    a = layers_of(pixels, "a.exr", settings=edit)
    b = layers_of(vertices, "b.exr", settings=edit)
    c = layers_of(pixels, "c.exr", settings=edit, reference=True, spp=256)
    for name in LAYERS:
        mean = c[name].mean((0, 1))
        assert mean.min() > 0.001
        np.testing.assert_allclose(a[name].mean((0, 1)), mean, rtol=0.03, err_msg=name)
        np.testing.assert_allclose(a[name].mean((0, 1)), b[name].mean((0, 1)), rtol=0.03, err_msg=name)
    noise = np.sqrt(c["variance"].mean() / (c[""] ** 2).mean())
    assert noise < 0.03
    assert relative_rmse(a[""], c[""]) ** 2 - noise**2 < 0.03**2
    np.testing.assert_allclose(sum(a[name] for name in LAYERS), a[""], rtol=1e-5, atol=1e-6)


def test_direct_light_is_that_without_interreflections(scene, tmp_path):
    # To the bit where no face is cut; else rays may end on either side of a cut's roundings. The picture has finer
    # outlines and textures.
    for subdivide in (False, True):
        plain, both = (
            make_store(
                scene, tmp_path / f"{subdivide}{k}.zarr", receivers=PIXELS, bounces=k, subdivide=subdivide, **COARSE
            )
            for k in (0, 2)
        )
        a, b = formats.open_store(plain), formats.open_store(both)
        assert "receivers/vertex" not in a
        count = a.array("receivers/side").shape[0]
        for name in ("position", "normal", "object", "side", "pixel", "view"):
            np.testing.assert_array_equal(a.read(f"receivers/{name}"), b.read(f"receivers/{name}")[:count])
        for name in ("visibility/bits", "lights/bits"):
            off = np.unpackbits(a.read(name) ^ b.read(name)[:count]).mean()
            assert off < 1e-4 if subdivide else off == 0
        one, two = (layers_of(store, "a.exr", bounces=0)[""] for store in (plain, both))
        np.testing.assert_allclose(one.mean((0, 1)), two.mean((0, 1)), rtol=0.02)


def test_hits_are_of_vertices(pixels):
    store = formats.open_store(pixels)
    hit, vertex = store.read("bounce/hit"), store.read("receivers/vertex")
    count = store.array("receivers/pixel").shape[0]
    assert (vertex[:count] == -1).all()
    assert (vertex[count:] >= 0).all()
    for part in (hit[:count], hit[count:]):
        assert part.any()
        assert part[part > 0].min() > count
        assert part.max() <= len(vertex)


def test_as_many_bounces_as_asked(pixels):
    two = layers_of(pixels, "a.exr")
    one = layers_of(pixels, "b.exr", bounces=1)
    np.testing.assert_array_equal(one["one_bounce"], two["one_bounce"])
    four = layers_of(pixels, "c.exr", bounces=4)
    np.testing.assert_array_equal(four["two_bounce"], two["two_bounce"])
    assert 0 < four["four_bounce"].mean() < four["three_bounce"].mean() < four["two_bounce"].mean()


def test_in_parts_and_in_frames(pixels, tmp_path, monkeypatch):
    # The same picture whether pixels are gathered at once, in parts, or in parts that are not kept; frame after frame.
    shots = tmp_path / "shots.toml"
    shots.write_text(
        "format = 1\nframes = 2\n[[key]]\nframe = 1\nenv = 'smooth'\nenv_rotate = 0\n"
        "[[key]]\nframe = 2\nenv_rotate = 90\n"
    )

    def frames(name):
        output = tmp_path / f"{name}#.exr"
        relight(RelightConfig(store=pixels, output=str(output), frames=shots, layers=True, background=True, quiet=True))
        return [read_layers(tmp_path / f"{name}{k}.exr") for k in (1, 2)]

    whole = frames("whole")
    assert relative_rmse(whole[1][""], whole[0][""]) > 0.01
    monkeypatch.setattr(lighting, "ENTRIES", 100 * 6 * 16 * 16)
    parts = [frames("parts")]
    monkeypatch.setattr(lighting, "IN_MEMORY", 1000)
    monkeypatch.setattr(lighting.LightingStore, "kept", 1000)
    parts.append(frames("lost"))
    for found in parts:
        for a, b in zip(found, whole, strict=True):
            for name in b:
                np.testing.assert_array_equal(a[name], b[name])


def test_begun_stores_light_what_was_traced(pixels, monkeypatch):
    """As a dry run times them, part by part: whole as any store, of some runs these alone."""
    monkeypatch.setattr(lighting, "IN_MEMORY", 0)
    monkeypatch.setattr(check_cost, "Draft", lambda writer: writer)
    store = formats.open_store(pixels)
    whole = LightingStore(store, 1)

    def shine(made):
        view = np.tile(np.float32([0, 0.8, 0.6]), (len(made), 1))
        return made.exit_radiance(smooth_map(), 20.0, made.scene.materials, view, None, None, 2)

    expected = shine(whole)
    for part, same in zip(shine(check_cost._Begun(store, 1, [slice(0, len(whole))])), expected, strict=True):
        np.testing.assert_array_equal(part.diffuse, same.diffuse)
        np.testing.assert_array_equal(part.specular, same.specular)
    runs = [slice(64, 128), slice(500, 520), slice(whole.pixels - 30, len(whole))]
    own = np.concatenate([np.arange(run.start, run.stop) for run in runs])
    begun = check_cost._Begun(store, 1, runs)
    assert begun.kept == int(LightingStore.kept * len(own) / len(whole))
    found = shine(begun)
    np.testing.assert_array_equal(found[0].specular[own], expected[0].specular[own])
    for part in found[1:]:
        lit = part.diffuse.any(axis=1)
        assert lit[own].any()
        lit[own] = False
        assert not lit.any()


def test_radiance_stores_hold_vertices_too(pixels, vertices, tmp_path):
    found = {}
    for store in (pixels, vertices):
        output = tmp_path / store.name
        relight(RelightConfig(store=store, output=str(output), env="smooth", quiet=True))
        found[store] = formats.open_store(output).read("radiance")[0]
    own = found[pixels][-len(found[vertices]) :]
    # The same vertices but for the seeds of their checks and hits.
    assert relative_rmse(own, found[vertices]) < 0.02
    assert found[pixels][: -len(own)].min() >= 0


def test_bound_to_the_camera(pixels, tmp_path):
    with pytest.raises(StoreError, match="pixels of camera 'main'"):
        layers_of(pixels, "a.exr", camera="other")
    with pytest.raises(StoreError, match="not vertices"):
        relight(RelightConfig(store=pixels, output=str(tmp_path / "a.ply"), env="smooth", quiet=True))


def test_same_bytes_however_it_was_made(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "block_size", lambda resolution: 256)
    monkeypatch.setattr(visibility_job, "block_size", lambda resolution: 256)

    def config(name, workers):
        output = tmp_path / name
        return Config(
            scene=scene,
            output=output,
            receivers=PIXELS,
            bounces=1,
            workers=workers,
            quiet=True,
            subdivide=False,
            **COARSE,
        )

    precompute(config("whole.zarr", 1))
    with monkeypatch.context() as patch:
        Stopping(patch, 4, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            precompute(config("parts.zarr", 1))
    run.close_worker()
    assert precompute(config("parts.zarr", 2))["status"] == "resumed"
    assert array_bytes(tmp_path / "parts.zarr") == array_bytes(tmp_path / "whole.zarr")


def test_dry_run_counts_both(scene, pixels, tmp_path):
    asked = {"receivers": PIXELS, "bounces": 2, "light_resolution": 32}
    dry = precompute(Config(scene=scene, output=tmp_path / "t.zarr", dry_run=True, **asked))
    assert not list(tmp_path.iterdir())
    store = formats.open_store(pixels)
    assert dry["receivers"] == store.array("receivers/side").shape[0]
    rays = sum(block["rays"] for block in store.blocks)
    assert 0.5 < dry["predicted"]["rays"] / rays < 2


def test_a_camera_that_sees_nothing(tmp_path):
    away = Camera("main", (0, 1, 3), (0, 1, 9), fov=20, size=(4, 4))
    parts = {"ground": square(3), "ball": sphere(0.5, (0, 0.6, 0), rings=8)}
    scene = write_scene(tmp_path, parts, [away], {"sky": np.ones((2, 4, 3))})
    store = make_store(scene, receivers=PIXELS, bounces=1, subdivide=False, **COARSE)
    assert not layers_of(store, "a.exr", env="sky")[""].any()

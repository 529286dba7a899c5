"""relight --reference as a stage: layers, variance, resuming, the same picture for any number of workers."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.errors import InputError
from relightcli.run import blocks as run
from relightcli.scene.model import Camera
from relightcli.stages import reference as stage
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import read_layers, write_scene

CAMERA = Camera("main", (0, 1.5, 3), (0, 0.3, 0), fov=40, size=(16, 12))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {
        "ground": square(4, material=lambert((0.8, 0.6, 0.4))),
        "ball": sphere(0.5, (0, 0.5, 0), rings=12, material=lambert(0.7)),
    }
    maps = {"white": np.ones((4, 8, 3)), "patchy": np.random.default_rng(0).random((8, 16, 3)) ** 3}
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], maps, adjustable=True)


def render(scene, output, **settings):
    defaults = {"env": "patchy", "spp": 16, "workers": 1, "reference": True, "quiet": True}
    return relight(Config(store=scene, output=str(output), **{**defaults, **settings}))


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of three rows."""
    monkeypatch.setattr(stage, "PATHS_PER_BLOCK", 3 * 16 * 16)


def test_same_bytes_for_any_number_of_workers(scene, tmp_path, small_blocks):
    for workers in (1, 2):
        result = render(scene, tmp_path / f"{workers}.exr", workers=workers, bounces=1, layers=True)
        assert result["reference"] is True
        assert result["spp"] == 16
        assert result["rays"] > 16 * 16 * 12
    assert (tmp_path / "1.exr").read_bytes() == (tmp_path / "2.exr").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.exr", "2.exr"]


def test_resumed_renderings_are_the_same(scene, tmp_path, small_blocks, monkeypatch):
    render(scene, tmp_path / "whole.exr")
    original, left = stage.ReferenceWorker.run, [2]

    def stopping(worker, block):
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return original(worker, block)

    with monkeypatch.context() as patch:
        patch.setattr(stage.ReferenceWorker, "run", stopping)
        with pytest.raises(KeyboardInterrupt):
            render(scene, tmp_path / "parts.exr")
    run.close_worker()
    assert (tmp_path / "parts.exr.samples.partial").is_dir()
    assert not (tmp_path / "parts.exr").exists()
    render(scene, tmp_path / "parts.exr")
    assert (tmp_path / "parts.exr").read_bytes() == (tmp_path / "whole.exr").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.exr", "whole.exr"]


def test_variance_says_how_far_seeds_differ(scene, tmp_path):
    pictures, variances = [], []
    for seed in range(6):
        render(scene, tmp_path / "a.exr", seed=seed, spp=64, bounces=1)
        layers = read_layers(tmp_path / "a.exr")
        pictures.append(layers[""])
        variances.append(layers["variance"])
    inside = layers["A"] == 1
    measured = np.var(pictures, axis=0, ddof=1)[inside].mean()
    # Six seeds, some 100 pixels of 3 colours: the mean variance is known to about 10 %.
    assert np.mean(variances, axis=0)[inside].mean() == pytest.approx(measured, rel=0.35)


def test_layers_bounces_and_background(scene, tmp_path):
    render(scene, tmp_path / "a.exr", env="white", bounces=2, layers=True, background=True, spp=64)
    layers = read_layers(tmp_path / "a.exr")
    assert set(layers) == {"", "A", "direct", "specular", "one_bounce", "two_bounce", "background", "variance"}
    total = sum(layers[name] for name in ("direct", "specular", "one_bounce", "two_bounce", "background"))
    np.testing.assert_allclose(total, layers[""], rtol=1e-5, atol=1e-6)
    assert (layers["A"] == 1).all()
    # L = 1 everywhere: the background is 1, and albedo below 1 keeps everything else below.
    assert layers["background"].max() == pytest.approx(1.0, abs=1e-6)
    assert layers["direct"].mean() > layers["one_bounce"].mean() > layers["two_bounce"].mean() > 0
    assert layers[""].max() < 1.02


def test_set_acts_on_the_reference(scene, tmp_path):
    render(scene, tmp_path / "a.exr", env="white", settings=("ground.diffuse=0,0,0", "ball.diffuse=0,0,0"))
    assert not read_layers(tmp_path / "a.exr")[""].any()


def test_outside_files_need_permission(scene, tmp_path):
    folder = tmp_path / "inner"
    folder.mkdir()
    text = (
        scene.read_text().replace("mesh = '", f"mesh = '{scene.parent}/").replace("map = '", f"map = '{scene.parent}/")
    )
    (folder / "scene.toml").write_text(text)
    with pytest.raises(InputError, match="--allow-outside"):
        render(folder / "scene.toml", tmp_path / "a.exr")
    render(folder / "scene.toml", tmp_path / "a.exr", allow_outside=True, spp=1)
    assert (tmp_path / "a.exr").exists()


def test_moved_objects_are_where_another_scene_file_has_them(tmp_path):
    ball = sphere(0.5, rings=8, material=lambert(0.7))
    parts = {"ground": square(4, material=lambert(0.5)), "ball": ball}
    maps = {"patchy": np.random.default_rng(0).random((4, 8, 3))}
    pictures = []
    for name, place, move in (("here", (0, 0.5, 0), ()), ("there", (1, 0.7, 0), ("ball=0,0.5,0", "lamp=0,2,0"))):
        height = 2 if name == "here" else 3
        path = write_scene(tmp_path / name, parts, [CAMERA], maps)
        text = path.read_text().replace(
            "mesh = 'ball.obj'", f"mesh = 'ball.obj'\nmotion = 'rigid'\ntranslate = {list(place)}"
        )
        lamp = f"[lights.lamp]\nshape = 'sphere'\ncenter = [0, {height}, 0]\nradius = 0.2\nradiance = [5, 5, 5]\n"
        path.write_text(text + lamp)
        render(path, tmp_path / f"{name}.exr", moves=move, bounces=1)
        pictures.append(read_layers(tmp_path / f"{name}.exr")[""])
    assert pictures[0].max() > 0.0
    np.testing.assert_array_equal(*pictures)


def test_only_what_is_there_can_be_moved(scene, tmp_path):
    with pytest.raises(InputError, match=r"objects.ball.motion is 'static'"):
        render(scene, tmp_path / "a.exr", moves=("ball=0,1,0",))

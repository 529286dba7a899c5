"""precompute: the same bytes however it ran, resuming, refusing; what the store says about itself."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import relight_formats as formats
from relightcli.errors import InputError, StoreError
from relightcli.run import blocks as run
from relightcli.scene.model import Camera, Material
from relightcli.stages import precompute as stage
from relightcli.stages import visibility_job
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, picture, write_scene

CAMERA = Camera("main", (0, 1.5, 3), (0, 0.3, 0), fov=40, size=(24, 16))
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {"ground": square(4, material=lambert(0.5)), "ball": sphere(0.5, (0, 0.6, 0), rings=12)}
    sky = np.random.default_rng(0).random((8, 16, 3))
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], {"sky": sky})


def config(scene, output, **settings):
    defaults = {
        "light_resolution": 16,
        "refine": 2,
        "workers": 1,
        "quiet": True,
        "bounces": None if "effects" in settings else 0,
    }
    return Config(scene=scene, output=output, **{**defaults, **settings})


def array_bytes(store):
    """Content of every array file of a store, by name."""
    return {
        str(path.relative_to(store)): path.read_bytes()
        for path in sorted(store.rglob("*"))
        if path.is_file() and path.relative_to(store).parts[0] not in ("ledger",) and path.name != "zarr.json"
    }


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of 64 receivers, so that a small scene has many."""
    monkeypatch.setattr(stage, "block_size", lambda resolution: 64)
    monkeypatch.setattr(visibility_job, "block_size", lambda resolution: 64)


@pytest.mark.parametrize("basis", ["visibility", "haar", "sh", "dense"])
def test_same_bytes_for_any_number_of_workers(scene, tmp_path, small_blocks, basis):
    stores = []
    bounces = 2 if basis == "visibility" else 0
    for workers in (1, 2, 3) if basis == "haar" else (1, 2):
        output = tmp_path / f"{workers}.zarr"
        result = precompute(config(scene, output, workers=workers, basis=basis, coefficients=16, bounces=bounces))
        assert result["status"] == "written"
        stores.append(array_bytes(output))
    assert len(stores[0]) > 10
    assert all(s == stores[0] for s in stores[1:])
    blocks = formats.open_store(tmp_path / "1.zarr", "transfer").blocks
    assert len(blocks) > 5
    assert all({"seconds", "rays", "peak_bytes"} <= set(b) for b in blocks)


class Stopping:
    """Wraps the worker's run: after some blocks it is interrupted or fails."""

    def __init__(self, monkeypatch, after, error):
        self.left, self.error = after, error
        self.run = visibility_job.VisibilityWorker.run
        monkeypatch.setattr(visibility_job.VisibilityWorker, "run", lambda worker, block: self(worker, block))

    def __call__(self, worker, block):
        if self.left == 0:
            raise self.error
        self.left -= 1
        return self.run(worker, block)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")], ids=["sigint", "disk"])
def test_resumed_runs_give_the_same_bytes(scene, tmp_path, small_blocks, monkeypatch, error):
    precompute(config(scene, tmp_path / "whole.zarr"))
    output = tmp_path / "parts.zarr"
    for after in (0, 1, 2):
        with monkeypatch.context() as patch:
            Stopping(patch, after, error)
            with pytest.raises(type(error)):
                precompute(config(scene, output))
        run.close_worker()
        assert not output.exists()
        assert output.with_name("parts.zarr.partial").is_dir()
    result = precompute(config(scene, output, workers=2))
    assert result["status"] == "resumed"
    assert not output.with_name("parts.zarr.partial").exists()
    assert array_bytes(output) == array_bytes(tmp_path / "whole.zarr")


def test_unfinished_work_of_other_settings_is_refused(scene, tmp_path, small_blocks, monkeypatch):
    output = tmp_path / "t.zarr"
    with monkeypatch.context() as patch:
        Stopping(patch, 1, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            precompute(config(scene, output))
    run.close_worker()
    with pytest.raises(StoreError):
        precompute(config(scene, output, seed=7))
    assert precompute(config(scene, output, seed=7, overwrite=True))["status"] == "written"


def test_up_to_date(scene, tmp_path):
    output = tmp_path / "t.zarr"
    precompute(config(scene, output))
    mark = output / "zarr.json"
    os.utime(mark, (1, 1))
    result = precompute(config(scene, output, workers=2))  # workers do not change the result
    assert result["status"] == "up to date"
    assert mark.stat().st_mtime > 1e9  # refreshed for Make


@pytest.mark.parametrize(
    "change",
    [
        {"light_resolution": 32},
        {"refine": 1},
        {"seed": 1},
        {"basis": "sh"},
        {"receivers": "pixels:main"},
        {"effects": "direct"},
        {"subdivide": False},
    ],
    ids=str,
)
def test_other_settings_are_refused(scene, tmp_path, change):
    output = tmp_path / "t.zarr"
    precompute(config(scene, output))
    before = array_bytes(output)
    with pytest.raises(StoreError, match=r"t\.zarr: a finished store is there.*--overwrite"):
        precompute(config(scene, output, **change))
    assert array_bytes(output) == before


def test_other_inputs_are_refused(scene, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(scene.parent, folder)
    output = tmp_path / "t.zarr"
    precompute(config(folder / "scene.toml", output))
    mesh = folder / "ball.obj"
    mesh.write_text(mesh.read_text() + "# another byte\n")
    with pytest.raises(StoreError):
        precompute(config(folder / "scene.toml", output))
    assert precompute(config(folder / "scene.toml", output, overwrite=True))["status"] == "written"


def test_dry_run_writes_nothing(scene, tmp_path):
    result = precompute(config(scene, tmp_path / "t.zarr", dry_run=True))
    assert list(tmp_path.iterdir()) == []
    assert result["dry_run"] is True
    assert [row["effect"] for row in result["plan"] if row["simulate"]] == ["direct", "shadows"]
    made = precompute(config(scene, tmp_path / "t.zarr"))
    assert made["receivers"] == result["receivers"]
    # Rays predicted from a pilot at five places.
    assert result["predicted"]["rays"] == pytest.approx(made["rays"], rel=0.3)


def test_left_to_itself_it_simulates_the_interreflections_that_count(scene, tmp_path):
    plan = precompute(config(scene, tmp_path / "t.zarr", effects="auto", dry_run=True))
    precompute(config(scene, tmp_path / "t.zarr", effects="auto"))
    store = formats.open_store(tmp_path / "t.zarr", "transfer")
    assert store.settings["bounces"] == plan["bounces"] >= 1
    assert store.settings["bounce_resolution"] == 8  # matte, and a tenth of the light bounces
    stored, told = ({row["effect"]: row for row in rows} for rows in (store.attrs["plan"], plan["plan"]))
    assert 0.03 < stored["one-bounce"]["share"] <= stored["one-bounce"]["bound"] < 0.2
    assert stored["one-bounce"]["bound"] == told["one-bounce"]["bound"]
    assert "predicted" not in stored["one-bounce"]
    for row in (told["shadows"], told["one-bounce"]):
        assert row["predicted"]["seconds"] > 0
        assert row["predicted"]["bytes"] > 0
    assert precompute(config(scene, tmp_path / "t.zarr", effects="auto"))["status"] == "up to date"
    # A scene that accepts more error does with less.
    text = scene.read_text() + "[accuracy]\ntolerance = 0.5\n"
    shutil.copytree(scene.parent, tmp_path / "coarse")
    (tmp_path / "coarse" / "scene.toml").write_text(text)
    coarse = precompute(config(tmp_path / "coarse" / "scene.toml", tmp_path / "c.zarr", effects="auto", dry_run=True))
    assert coarse["bounces"] == 0
    assert coarse["predicted"]["bytes"] < plan["predicted"]["bytes"]


def test_summary_agrees_with_the_store(scene, tmp_path):
    result = precompute(config(scene, tmp_path / "t.zarr", refine=4, light_resolution=32))
    store = formats.open_store(tmp_path / "t.zarr", "transfer")
    assert result["receivers"] == len(store.read("receivers/position"))
    assert result["bytes"] == sum(size.stored for size in store.sizes().values())
    assert 0 <= result["wrong_bits"] < 1e-2
    assert result["rays"] > 0
    assert store.read("visibility/bits").shape == (result["receivers"], 6, 32, 4)
    assert [row["effect"] for row in store.attrs["plan"] if row["simulate"]] == ["direct", "shadows"]
    normals = store.read("receivers/normal")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"light_resolution": 20}, "--light-resolution: .* found 20"),
        ({"light_resolution": 8}, "--light-resolution: .* found 8"),
        ({"refine": 3}, "--refine: expected 1, 2, 4 or 8.* found 3"),
        ({"refine": 8}, "--refine: .*a quarter of --light-resolution; found 8"),
        ({"basis": "wavelet"}, "--basis: expected one of .* found 'wavelet'"),
        ({"coefficients": 0}, "--coefficients: expected 1 to 1536; found 0"),
        ({"basis": "sh", "sh_order": 17}, "--sh-order: expected 1 to 16; found 17"),
        ({"bounces": 65}, "--bounces: expected 0 to 64; found 65"),
        ({"bounces": 1, "light_resolution": 24, "bounce_resolution": 16}, "--bounce-resolution: .* \\(24\\); found 16"),
        ({"effects": "magic"}, "--effects: .* found 'magic'"),
        ({"receivers": "texels"}, "--receivers: expected vertices or pixels:CAMERA; found 'texels'"),
        ({"receivers": "pixels:side"}, "has no camera 'side'; it has: main"),
    ],
    ids=str,
)
def test_bad_settings(scene, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        precompute(config(scene, tmp_path / "t.zarr", **change))
    assert not (tmp_path / "t.zarr").exists()


def test_any_seed(scene, tmp_path):
    for seed in (-1, 2**64):
        precompute(config(scene, tmp_path / f"{seed}.zarr", seed=seed))


def test_missing_scene_and_missing_folder(scene, tmp_path):
    with pytest.raises(InputError, match=r"none\.toml"):
        precompute(config(tmp_path / "none.toml", tmp_path / "t.zarr"))
    with pytest.raises(InputError, match="nowhere does not exist"):
        precompute(config(scene, tmp_path / "nowhere" / "t.zarr"))


def test_a_camera_that_sees_nothing(scene, tmp_path):
    away = Camera("main", (0, 1, 3), (0, 1, 9), fov=20, size=(4, 4))
    blind = write_scene(tmp_path, {"ball": sphere(0.5, rings=4)}, [away], {"sky": np.ones((2, 4, 3))})
    for receivers in ("vertices", "pixels:main"):
        store = make_store(blind, f"{receivers[0]}.zarr", receivers=receivers, light_resolution=16, refine=2)
        rgb, alpha = picture(store)
        assert not rgb.any()
        assert not alpha.any()


def test_bases_against_visibility(scene, tmp_path):
    # All Haar coefficients and the dense transfer are one sum; SH of order 6 leaves out what lies above band 5.
    from relightcli.stages.lighting import LightingStore

    latitude = np.pi * (0.5 - (np.arange(16) + 0.5) / 16)
    environment = np.broadcast_to((1 + 0.5 * np.sin(latitude))[:, None, None], (16, 32, 3)).astype(np.float32)
    radiance = {}
    for basis, more in (("dense", {}), ("haar", {"coefficients": 1536}), ("sh", {"sh_order": 6})):
        made = make_store(scene, f"{tmp_path}/{basis}.zarr", basis=basis, light_resolution=16, refine=2, **more)
        store = LightingStore(made, 1)
        white = {name: Material(name, diffuse=(1.0, 1.0, 1.0)) for name in store.scene.materials}
        radiance[basis] = store.exit_radiance(environment, 30.0, white, None)[0].diffuse
        radiance["visibility"] = store.exit_radiance(environment, 30.0, white, None, basis="visibility")[0].diffuse
    np.testing.assert_allclose(radiance["haar"], radiance["dense"], rtol=2e-5)
    # Texels' own centres against the light's mean direction, and the bilinear sharing: 1/16 of a texel's change.
    scale = radiance["visibility"].max()
    assert np.abs(radiance["dense"] - radiance["visibility"]).max() < 0.03 * scale
    assert np.sqrt(((radiance["sh"] - radiance["visibility"]) ** 2).mean()) < 0.03 * scale


def test_haar_error_falls_with_the_coefficients(scene, tmp_path):
    from relightcli.stages.lighting import LightingStore

    environment = np.random.default_rng(1).random((16, 32, 3)).astype(np.float32)
    exact, errors = None, []
    for count in (1536, 256, 64, 16):
        output = f"{tmp_path}/{count}.zarr"
        made = make_store(scene, output, basis="haar", coefficients=count, light_resolution=16, refine=2)
        store = LightingStore(made, 1)
        diffuse = store.exit_radiance(environment, 0.0, store.scene.materials, None)[0].diffuse
        exact = diffuse if exact is None else exact
        errors.append(float(np.sqrt(((diffuse - exact) ** 2).mean() / (exact**2).mean())))
    assert errors == sorted(errors)
    assert errors[1] < 0.01
    assert errors[3] < 0.2


def start(scene, output, *more):
    command = [sys.executable, "-m", "relightcli", "precompute", str(scene), "-o", str(output), "--refine", "1"]
    command += ["--light-resolution", "128", "--workers", "2", "-q", *more]
    return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True)


@pytest.fixture(scope="module")
def long_scene(tmp_path_factory):
    """Takes about half a minute in two processes."""
    parts = {"ground": square(4, material=lambert(0.5)), "ball": sphere(0.5, (0, 0.6, 0), rings=40)}
    return write_scene(tmp_path_factory.mktemp("long"), parts, [CAMERA], {"sky": np.ones((2, 4, 3))})


def wait_for_blocks(output, process, count=1):
    deadline = time.monotonic() + 60
    partial = output.with_name(output.name + ".partial")
    while True:
        assert process.poll() is None, process.stderr.read().decode()
        assert time.monotonic() < deadline
        if len(recorded(partial)) >= count:
            return
        time.sleep(0.02)


def recorded(partial):
    return formats.progress(partial)["blocks"] if (partial / "zarr.json").exists() else []


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_interrupted_programs_say_so_and_resume(long_scene, tmp_path, signum):
    output = tmp_path / "t.zarr"
    process = start(long_scene, output)
    wait_for_blocks(output, process)
    os.killpg(process.pid, signum) if signum == signal.SIGINT else process.send_signal(signum)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode == 130, stderr.decode()
    assert b"Traceback" not in stderr
    assert b"run the same command again" in stderr
    assert not output.exists()
    before = len(recorded(output.with_name("t.zarr.partial")))
    assert before >= 1
    process = start(long_scene, output)
    wait_for_blocks(output, process, before)
    process.kill()  # and killed, for good measure
    process.communicate()
    assert not output.exists()


def test_an_interrupt_while_libraries_load_is_not_lost(scene, tmp_path):
    # trimesh catches everything that its optional imports raise; the interrupt comes at the first of them.
    code = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.startswith('trimesh.') and not self.done:\n"
        "            self.done = True\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "    done = False\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from relightcli.cli.main import run\n"
        f"sys.exit(run(['precompute', {str(scene)!r}, '-o', {str(tmp_path / 't.zarr')!r}, '--workers', '1']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, timeout=60, check=False)
    assert done.returncode == 130, done.stderr.decode()
    assert not (tmp_path / "t.zarr").exists()

"""precompute --tolerance tries again: faces that are too large to carry shadows are whole where that keeps it, else
cut; settings that a trial has promised too much of get finer."""

from __future__ import annotations

import pytest

import relight_formats as formats
from relightcli.errors import NumericalError
from relightcli.scene.model import Camera
from relightcli.stages import precompute as stage
from relightcli.stages import prepare as preparing
from relightcli.stages import promise
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from relightcli.stages.promise import Decided
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import write_scene
from tests.stages.test_precompute import array_bytes
from tests.stages.test_promise import grid

CAMERA = Camera("main", (0, 1.6, 2.6), (0, 0.3, 0), fov=40, size=(32, 24))
SMALL = {"light_resolution": 16, "bounces": 0}


def scene_of(folder, ground):
    ball = sphere(0.4, (0, 0.5, 0), rings=16)
    ball.material = lambert((0.6, 0.5, 0.2))
    return write_scene(folder, {"ground": ground, "ball": ball}, [CAMERA], {})


@pytest.fixture(scope="module")
def fine(tmp_path_factory):
    """A ground that tessellation would cut, though it carries shadows well enough for some."""
    return scene_of(tmp_path_factory.mktemp("fine"), grid(2, 24, lambert((0.5, 0.4, 0.3))))


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A ground of two triangles, which carries none."""
    return scene_of(tmp_path_factory.mktemp("coarse"), square(2, material=lambert(0.5)))


def run(scene, output, **settings):
    told = precompute(Config(scene, output, quiet=True, workers=1, **{**SMALL, **settings}))
    return told, formats.open_store(output)


def interrupted_at_the_second(monkeypatch):
    """What checks have said, to be read later; after the second of them the run is interrupted."""
    checks = []
    keep = stage.keep_promise

    def checked(*arguments):
        checks.append(keep(*arguments))
        if len(checks) == 2:
            raise KeyboardInterrupt
        return checks[-1]

    monkeypatch.setattr(stage, "keep_promise", checked)
    return checks


def test_faces_stay_whole_where_that_will_do(fine, tmp_path):
    told, store = run(fine, tmp_path / "t.zarr", tolerance=0.3)
    assert store.settings["faces"] == "whole"
    assert not any("cut" in note for note in told["notes"])
    assert "source/face" not in store
    assert store.attrs["measured_error"]["share"] <= 0.3
    kept = run(fine, tmp_path / "kept.zarr", subdivide=False)[1]
    assert store.layouts["mesh/face"].shape == kept.layouts["mesh/face"].shape
    cut = run(fine, tmp_path / "cut.zarr")[1]
    assert cut.layouts["mesh/face"].shape > store.layouts["mesh/face"].shape
    assert "faces" not in cut.settings
    assert run(fine, tmp_path / "t.zarr", tolerance=0.3)[0]["status"] == "up to date"
    dry = precompute(Config(fine, tmp_path / "d.zarr", tolerance=0.3, dry_run=True, workers=1, **SMALL))
    assert dry["receivers"] == told["receivers"]
    assert any("whole" in note for note in dry["notes"])


def test_they_are_cut_where_direct_light_says_so(coarse, tmp_path):
    told, store = run(coarse, tmp_path / "t.zarr", tolerance=0.15)
    assert store.settings["faces"] == "cut"
    assert any("cut" in note for note in told["notes"])
    assert store.attrs["measured_error"]["share"] <= 0.15


def test_they_are_cut_where_only_the_check_says_so(coarse, tmp_path, monkeypatch):
    usual = run(coarse, tmp_path / "usual.zarr", tolerance=0.15)[1]
    # As where interreflections want finer faces than direct light does.
    monkeypatch.setattr(preparing, "direct_keeps", lambda *_: True)
    monkeypatch.setattr(stage, "need_reach", lambda *_: None)
    checks = interrupted_at_the_second(monkeypatch)
    output = tmp_path / "t.zarr"
    with pytest.raises(KeyboardInterrupt):
        run(coarse, output, tolerance=0.15)
    assert checks == [Decided("cut"), None]
    told, store = run(coarse, output, tolerance=0.15)  # goes on with the cut ones
    assert len(checks) == 3
    assert told["status"] == "resumed"
    assert store.settings == usual.settings
    assert array_bytes(output) == array_bytes(tmp_path / "usual.zarr")
    assert run(coarse, output, tolerance=0.15)[0]["status"] == "up to date"


def test_a_trial_that_promised_too_much_is_tried_again_with_more_care(fine, tmp_path, monkeypatch):
    """As where no sky of the trial shines in where one of the check does."""
    smooth = {"overcast": promise.check_skies()["overcast"]}
    monkeypatch.setattr(promise, "trial_skies", lambda: smooth)
    settings = {"tolerance": 0.03, "light_resolution": None, "bounces": 2, "receivers": "pixels:main"}
    checks = interrupted_at_the_second(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        run(fine, tmp_path / "t.zarr", **settings)
    told, store = run(fine, tmp_path / "t.zarr", **settings)
    assert told["status"] == "resumed"
    assert checks[0].care > 1.0
    assert checks[1:] == [None, None]
    assert store.settings["care"] == checks[0].care
    tried = [(one["light_resolution"], one["pixel_grid"]) for one in store.attrs["tried"]]
    chosen = store.settings["light_resolution"], store.settings.get("pixel_grid", 1)
    assert tried.index(chosen) > 0  # the trial takes the first to be enough
    assert store.attrs["measured_error"]["share"] <= 0.03
    assert run(fine, tmp_path / "t.zarr", **settings)[0]["status"] == "up to date"
    with pytest.raises(NumericalError, match="What would help"):  # nothing finer is left to try
        run(fine, tmp_path / "no.zarr", **{**settings, "light_resolution": 16, "pixel_grid": 1})

"""--tolerance for characters: models that keep it in poses not learnt from, and what is said of a miss."""

from __future__ import annotations

import re

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.images import write_image
from relightcli.cli.main import run as run_command
from relightcli.core.lights.sky import sky_latlong
from relightcli.stages import measured_error
from relightcli.stages.budget import budget
from relightcli.stages.fit_pose import Config, fit_pose
from relightcli.stages.promise_pose import CHECK, CHOSEN, TRIAL, poses_between, smallest
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.stages.pose_files import SCENE, pose_scene
from tests.stages.scene_files import make_store, read_layers

SMALL = {"light_resolution": 32, "pose_directions": 256, "bounces": 0, "workers": 1}
TOLERANCE = 0.3


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pose-promise")
    scene = pose_scene(folder, SCENE.replace("size = [20, 16]", "size = [24, 18]"))
    return make_store(scene, tolerance=TOLERANCE, **SMALL)


def fit(transfer, name, **settings):
    output = transfer.parent / name
    return fit_pose(Config(store=transfer, output=output, quiet=True, workers=1, **settings)), output


def test_the_tolerance_of_precompute_is_kept_in_other_poses(transfer):
    trained = formats.open_store(transfer)
    assert "measured_error" not in trained.attrs
    assert trained.settings["tolerance"] == TOLERANCE
    done, output = fit(transfer, "kept.zarr")
    store = formats.open_store(output)
    measured = store.attrs["measured_error"]
    assert done["measured_error"] == measured["share"] <= measured["tolerance"] == TOLERANCE
    assert "bar=bend@" in measured["where"]
    checked = next(row for row in budget(store) if row["step"] == "check")
    assert [error["value"] for error in checked["errors"]] == [measured["share"]]
    # A moment and a sky that neither the choice nor the check knows, on all pixels of another camera's view.
    sky = output.parent / "sun.exr"
    write_image(sky, sky_latlong(42.0, 310.0, size=(64, 128)))
    given = {"env": str(sky), "poses": ("bar=bend@0.91",), "quiet": True, "workers": 1}
    pictures = [output.parent / f"{k}.exr" for k in "sab"]
    relight(RelightConfig(store=output, output=str(pictures[0]), **given))
    for seed, path in enumerate(pictures[1:]):
        truth = {"store": output, "reference": True, "spp": 64, "bounces": 3, "seed": seed}
        relight(RelightConfig(output=str(path), **truth, **given))
    s, a, b = (read_layers(path)[""].astype(float) for path in pictures)
    assert np.sqrt(max(((s - a) * (s - b)).sum(), 0.0) / (a * b).sum()) <= TOLERANCE
    assert fit(transfer, "kept.zarr")[0]["status"] == "up to date"


def test_a_miss_is_told_and_may_be_allowed(transfer, capsys, monkeypatch):
    monkeypatch.setattr(measured_error, "MOST_TIMES", 1)  # far off is far off
    output = transfer.parent / "miss.zarr"
    assert run_command(["fit-pose", str(transfer), "-o", str(output), "--tolerance", "0.001", "--workers", "1"]) == 4
    told = capsys.readouterr().err
    assert re.search(r"more than the tolerance of 0\.10%.*precompute --pose-(order 5|frames all).*--allow-miss", told)
    assert not output.exists()
    done, _ = fit(transfer, "miss.zarr", tolerance=0.001, allow_miss=True)
    assert done["status"] == "resumed"
    assert done["measured_error"] > 0.001


def test_the_smallest_model_that_keeps_it_is_taken():
    assert smallest([CHOSEN * 0.1], 0.1) == 0
    assert smallest([0.2, 0.05], 0.1) == 1
    # None does: one that is a tenth worse than the best is as good.
    assert smallest([0.5, 0.21, 0.2], 0.1) == 1


def test_poses_are_none_of_those_learnt_from(transfer):
    store = formats.open_store(transfer)
    trial, check = poses_between(store, TRIAL), poses_between(store, CHECK)
    frames = set(store.read("pose/0/seconds").tolist())
    assert len({*trial, *check}) == len(TRIAL) + len(CHECK)
    for (text,) in (*trial, *check):
        name, _, seconds = text.rpartition("@")
        assert name == "bar=bend"
        assert min(frames) < float(seconds) < max(frames)
        assert float(seconds) not in frames

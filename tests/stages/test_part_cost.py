"""Costs that dry runs of cluster, factorize and fit-pose predict, beside those of the stages themselves."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

import relight_formats as formats
from relightcli.stages.part_cost import Costs, grown
from tests.core.transport.scenes import lambert, sphere
from tests.stages.pose_files import SCENE, pose_scene
from tests.stages.scene_files import make_store, write_scene
from tests.stages.test_asset import CAMERA, ground
from tests.stages.test_bounces import GOLD

BYTES = 1.2  # set out to be reached
SECONDS = 5.0  # of processors: a check of orders of magnitude, as those on machines that others use are rough


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    parts = {
        "ground": ground(16, lambert((0.6, 0.5, 0.4))),
        "gold": sphere(0.35, (0.45, 0.36, 0.1), rings=12, material=GOLD),
    }
    scene = write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], {}, adjustable=True)
    return make_store(scene, workers=1, bounces=2, light_resolution=32, bounce_resolution=8, subdivide=False)


def check(stage, store, output, *options):
    """Runs a stage dry and then in earnest; whether it left nothing before, and took what it said."""
    told = run(stage, store, "-o", output, *options, "--dry-run")
    assert not output.exists()
    assert not output.with_name(output.name + ".partial").exists()
    done = run(stage, store, "-o", output, *options)
    predicted = told["predicted"]
    assert done["bytes"] / BYTES <= predicted["bytes"] <= done["bytes"] * BYTES
    spent = sum(step["cpu_seconds"] for step in formats.open_store(output).summary["steps"].values())
    assert spent / SECONDS <= predicted["cpu_seconds"] <= spent * SECONDS
    assert predicted["seconds"] > 0.0
    return output


def run(*command):
    """What a command says, in a process of its own whose matrix products do not wait for other threads."""
    line = [sys.executable, "-m", "relightcli", *map(str, command), "--workers", "1", "--json"]
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    return json.loads(subprocess.run(line, env=env, check=True, stdout=subprocess.PIPE).stdout)


def test_cluster_and_factorize(transfer):
    clusters = check("cluster", transfer, transfer.parent / "clusters.zarr", "--clusters", 4)
    check("factorize", clusters, transfer.parent / "asset.zarr", "--light-rank", 16)


@pytest.mark.parametrize("options", [(), ("--tolerance", 0.5)], ids=["asked", "chosen"])
def test_fit_pose(tmp_path, options):
    scene = pose_scene(tmp_path, SCENE.replace("size = [20, 16]", "size = [12, 9]"))
    store = make_store(scene, light_resolution=16, pose_directions=64, bounces=0, subdivide=False)
    check("fit-pose", store, tmp_path / "pose.zarr", *options)


def test_what_grows_is_told_from_what_does_not():
    asked = []

    def part(count):
        asked.append(count)
        loading = 5.0 if len(asked) == 1 else 0.0
        return Costs(loading + 1.0 + 0.1 * count, 2.0 * count, 100.0 + 3.0 * count)

    found = grown(part, (10, 30), 1000)
    assert asked == [10, 10, 30]
    assert found.seconds == pytest.approx(5.0 + 1.0 + 0.1 * 1000)
    assert found.cpu_seconds == pytest.approx(2.0 * 1000)
    assert found.bytes == pytest.approx(100.0 + 3.0 * 1000)
    assert grown(part, (10, 10), 10).bytes == 130.0

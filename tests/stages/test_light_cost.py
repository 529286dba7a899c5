"""What a dry run of clustered lights predicts, beside what the stage takes."""

from __future__ import annotations

import time

import pytest

from relightcli.stages import light_cost, light_growth
from relightcli.stages.light_clusters import Config, cluster_lights
from tests.core.transport.scenes import lambert, sphere
from tests.stages.scene_files import make_store, write_scene
from tests.stages.test_asset import CAMERA, ground
from tests.stages.test_light_clusters import GOLD

BYTES = 1.2  # set out to be reached
SECONDS = 4.0  # of processors: rough, as those of short runs on machines that others use are


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    parts = {
        "ground": ground(40, lambert((0.6, 0.5, 0.4))),
        "gold": sphere(0.35, (0.45, 0.36, 0.1), rings=12, material=GOLD),
    }
    scene = write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], {})
    return make_store(scene, light_resolution=32, subdivide=False)


def run(transfer, output, **options):
    """What the stage says, and the seconds of processors that it took."""
    begun = time.process_time()
    told = cluster_lights(Config(store=transfer, output=output, quiet=True, **options))
    return told, time.process_time() - begun


@pytest.mark.parametrize(
    ("options", "some"),
    [
        ({"resolution": 128, "epsilon": 0.1}, False),
        ({"resolution": 128, "epsilon": 0.1}, True),
        ({"resolution": 64, "epsilon": 0.2, "camera": "main"}, False),
        ({"resolution": 1024, "lights": 300}, False),
        ({"resolution": 64, "criterion": "paper", "epsilon": 5e-4}, False),
    ],
    ids=["every view", "some receivers", "one view", "budget", "paper"],
)
def test_costs(transfer, tmp_path, monkeypatch, options, some):
    if some:
        monkeypatch.setattr(light_cost, "FEW", 128)
        monkeypatch.setattr(light_cost, "SOME", 700)
        monkeypatch.setattr(light_cost, "RUNS", 12)
    output = tmp_path / "clusters.zarr"
    told, _ = run(transfer, output, dry_run=True, **options)
    assert list(tmp_path.iterdir()) == []
    done, spent = run(transfer, output, **options)
    predicted = told["predicted"]
    assert done["bytes"] / BYTES <= predicted["bytes"] <= done["bytes"] * BYTES
    assert done["light_clusters"] / BYTES <= told["light_clusters"] <= done["light_clusters"] * BYTES
    assert spent / SECONDS <= predicted["cpu_seconds"] <= spent * SECONDS
    assert predicted["seconds"] > 0.0


def test_few_cells_stand_for_all(transfer, tmp_path, monkeypatch):
    """Of thousands of cells no more than KEPT a level are split, however many lights there are."""
    asked = {"resolution": 256, "epsilon": 0.02, "dry_run": True}
    judged = []
    grow = light_cost.grow

    def counted(*arguments):
        nodes = grow(*arguments)
        judged.append(len(nodes))
        return nodes

    monkeypatch.setattr(light_cost, "grow", counted)
    some = run(transfer, tmp_path / "t.zarr", **asked)[0]
    monkeypatch.setattr(light_growth, "KEPT", 3 * light_growth.KEPT)
    more = run(transfer, tmp_path / "t.zarr", **asked)[0]
    assert judged[0] < 0.5 * judged[1] < 0.2 * some["light_clusters"]
    assert some["light_clusters"] == pytest.approx(more["light_clusters"], rel=0.15)

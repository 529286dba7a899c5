"""The account of a store: steps within the run's time, bytes of all rows on disk, errors of every stage."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

import relight_formats as formats
from relightcli.plan.effects import bounces_needed, decide
from relightcli.plan.pilot import Share
from relightcli.run.accounting import Account, Meter
from relightcli.stages.budget import budget
from relightcli.stages.cluster import Config as ClusterConfig
from relightcli.stages.cluster import cluster
from relightcli.stages.factorize import Config as FactorizeConfig
from relightcli.stages.factorize import factorize
from relightcli.stages.inspect import inspect
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config as PrecomputeConfig
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, write_scene

ASKED = {"effects": "all", "bounces": 2, "light_resolution": 16, "bounce_resolution": 8}
LAMP = '[lights.lamp]\nshape = "sphere"\ncenter = [0, 2, 0]\nradius = 0.1\nradiance = [20, 20, 18]\n'


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    parts = {"ground": square(3, material=lambert(0.5)), "ball": sphere(0.4, (0, 0.5, 0), rings=8)}
    scene = write_scene(tmp_path_factory.mktemp("budget"), parts, [], {}, more=LAMP)
    # Two processes: blocks are counted where they are done.
    return make_store(scene, **ASKED, workers=2)


def by_step(store):
    return {row["step"]: row for row in budget(store)}


def on_disk(path):
    """Bytes of the files of arrays, without metadata."""
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file() and f.name != "zarr.json")


def test_rows_add_up_to_the_run_and_to_the_store(transfer):
    store = formats.open_store(transfer)
    rows = by_step(store)
    steps = {"reading", "planning", "receivers", "scene", "visibility", "local lights", "bounces", "rest"}
    assert set(rows) == steps
    assert sum(row["bytes"] for row in rows.values()) == on_disk(transfer)
    assert sum(row["seconds"] for row in rows.values()) == pytest.approx(store.summary["seconds"])
    # "rest" would take anything up: what has no name is little beside what has.
    assert rows["rest"]["seconds"] < 0.3 * store.summary["seconds"]
    blocks = [b for b in store.blocks if b["id"].startswith("visibility")]
    traced = ("visibility", "local lights", "bounces")
    assert sum(rows[name]["rays"] for name in traced) == sum(b["rays"] for b in blocks) > 0
    assert all(rows[name]["rays"] > 0 for name in traced)
    assert all(rows[name]["bytes"] > 0 for name in (*traced, "scene"))
    cpu = max(sum(b["cpu_seconds"] for b in blocks), store.summary["steps"]["visibility"]["cpu_seconds"])
    assert sum(rows[name]["cpu_seconds"] for name in traced) == pytest.approx(cpu)
    assert min(row["seconds"] for row in rows.values()) >= 0.0
    (error,) = rows["visibility"]["errors"]
    total = {key: sum(b[key] for b in blocks) for key in ("wrong", "checked", "inferred", "bits")}
    assert error["value"] == total["wrong"] / total["checked"] * total["inferred"] / total["bits"]


def test_later_stages_tell_what_came_before_and_what_they_leave_out(transfer, tmp_path):
    grouped, asset = tmp_path / "c.zarr", tmp_path / "a.zarr"
    cluster(ClusterConfig(transfer, grouped, clusters=2, tolerance=0.05, quiet=True))
    found = factorize(FactorizeConfig(grouped, asset, eigenvectors=4, light_rank=8, quiet=True))
    told = inspect(asset, verify=False)
    assert [part["kind"] for part in told["before"]] == ["transfer", "clusters"]
    assert told["before"][0]["rows"] == budget(formats.open_store(transfer))
    rows = {row["step"]: row for row in told["budget"]}
    for step in ("direct", "one-bounce", "two-bounce"):
        assert rows[step]["seconds"] > 0
        assert rows[step]["bytes"] > 0
        assert rows[step]["peak_bytes"] > 0
    assert sum(row["bytes"] for row in told["budget"]) == told["bytes"] == on_disk(asset)
    assert sum(row["seconds"] for row in told["budget"]) == pytest.approx(told["summary"]["seconds"])
    ranks, rounding = (error["value"] for error in rows["one-bounce"]["errors"])
    assert ranks == found["errors"]["one_bounce"]["compression"] > 0
    assert math.hypot(ranks, rounding) == pytest.approx(found["errors"]["one_bounce"]["total"])
    groups = {row["step"]: row for row in told["before"][1]["rows"]}
    assert 0 < groups["light-basis"]["errors"][0]["value"] < 0.2
    assert groups["light-basis"]["cpu_seconds"] > 0


def test_costs_are_no_content_and_are_predicted(transfer, tmp_path):
    """Two runs cost differently and are the same store; a dry run knows before what it will be."""
    scene = transfer.parent / "scene.toml"
    again = make_store(scene, "again.zarr", **ASKED, workers=1)
    a, b = formats.open_store(transfer), formats.open_store(again)
    assert a.fingerprint == b.fingerprint
    assert a.summary["steps"] != b.summary["steps"]
    told = precompute(PrecomputeConfig(scene, tmp_path / "no.zarr", **ASKED, workers=1, dry_run=True, quiet=True))
    predicted = told["predicted"]
    assert 1 / 1.2 <= predicted["bytes"] / on_disk(again) <= 1.2
    # Runs of 64 receivers, a third of all, stand for the rest: shadows are nowhere else than there.
    assert 1 / 1.2 <= predicted["rays"] / sum(b.get("rays", 0) for b in formats.open_store(again).blocks) <= 1.2
    # Both take a second or two, whoever else uses the machine; tracing alone is a small part of it.
    assert 1 / 4 <= predicted["seconds"] / b.summary["seconds"] <= 4
    assert list(tmp_path.iterdir()) == []


def test_bytes_of_what_is_convex_are_predicted(tmp_path):
    """No ray is traced, and horizons are stored all the same."""
    scene = write_scene(tmp_path / "scene", {"ball": sphere(0.4, (0, 0.5, 0), rings=24)}, [], {})
    store = make_store(scene, effects="auto", bounces=None)
    told = precompute(PrecomputeConfig(scene, tmp_path / "no.zarr", dry_run=True, quiet=True))
    assert told["predicted"]["rays"] == 0
    assert 1 / 1.2 <= told["predicted"]["bytes"] / on_disk(store) <= 1.2


def test_what_is_left_out_after_the_last_interreflection_is_told():
    tails = [Share(s, s, s, "a view") for s in (0.5, 0.2, 0.08, 0.03, 0.012)]

    class Pilot:
        def tails(self, allowed):
            return tails

        def shadows(self):
            raise AssertionError

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0], [1, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 4]], np.int32)
    assert bounces_needed(tails, 0.05) == 3
    for tolerance, rest in ((0.2, {"two-bounce": 0.08}), (0.1, {"two-bounce": 0.03}), (0.5, {"one-bounce": 0.2})):
        plan, _ = decide(None, corners, faces, True, False, None, tolerance, Pilot)
        assert {row.effect: row.rest for row in plan if row.rest is not None} == rest


def test_an_account_counts_what_fails_and_what_is_done_twice():
    account = Account()

    def fail():
        with account.step("a"):
            time.sleep(0.02)
            raise KeyError

    for _ in range(2):
        with pytest.raises(KeyError):
            fail()
    with account.step("b"):
        sum(range(200_000))
    assert list(account.steps) == ["a", "b"]
    assert 0.04 <= account.seconds("a") < 5
    assert account.steps["a"]["cpu_seconds"] < account.seconds("a")
    assert account.steps["b"]["cpu_seconds"] > 0
    assert account.seconds("none") == 0.0
    assert Meter().read()["peak_bytes"] > 1e6

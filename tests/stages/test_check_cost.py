"""What a dry run predicts of the check: the light of interreflections among it, which lobes make dear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relightcli.plan.pilot import NOTHING
from relightcli.run.accounting import Account
from relightcli.scene.model import Camera
from relightcli.stages import dry_run as dry
from relightcli.stages.check_cost import LightCosts, predict_check
from relightcli.stages.lighting import LightingStore
from relightcli.stages.measured_error import Judge
from relightcli.stages.precompute_config import Config
from relightcli.stages.prepare import prepare
from relightcli.stages.promise import Tried
from tests.core.transport.scenes import lambert, sphere
from tests.stages.scene_files import write_scene
from tests.stages.test_promise import grid

CAMERA = Camera("main", (0, 1.6, 2.6), (0, 0.3, 0), fov=40, size=(40, 30))
SETTINGS = {"receivers": "vertices", "basis": "visibility", "bounces": 2, "light_resolution": 16}
PICTURES = 7 * 1  # skies and views of the check


def both(value):
    return {"seconds": value, "cpu_seconds": 2.0 * value}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    parts = {"ground": grid(3, 20, lambert((0.5, 0.4, 0.3))), "ball": sphere(0.4, (0, 0.5, 0), rings=16)}
    shiny = replace(lambert((0.2, 0.3, 0.5)), model="blinn-phong", specular=(0.3, 0.3, 0.3), shininess=40.0)
    parts["ball"].material = shiny
    folder = tmp_path_factory.mktemp("check-cost")
    path = write_scene(folder, parts, [CAMERA], {})
    asked = {"tolerance": 0.3, "bounces": 2, "light_resolution": 16}
    return Config(path, folder / "t.zarr", quiet=True, subdivide=False, dry_run=True, **asked)


def test_light_grows_with_the_receivers():
    none = LightCosts(both(0.1), both(0.2), both(0.5))
    some = LightCosts(both(0.2), both(0.5), both(0.4))
    grown = some.grown(none, 10.0)
    assert grown.direct["seconds"] == pytest.approx(0.1 + 10 * 0.1)
    assert grown.bounced["cpu_seconds"] == pytest.approx(2 * (0.2 + 10 * 0.3))
    assert grown.once["seconds"] == 0.5  # no less than without any


def test_every_picture_of_the_check_has_the_light_of_interreflections(config, monkeypatch):
    monkeypatch.setattr(Judge, "trace", lambda *_, **__: np.zeros((1, 3)))
    prepared = prepare(config, Account())
    tried = [Tried(16, 1, NOTHING, both(0.25), 1.0)]
    light = LightCosts(both(100.0), both(3.0), both(7.0))
    asked = (None, prepared.scene, prepared.source, 2)
    found = predict_check(*asked, tried, light)
    # The rest is the few microseconds that the mocked tracing takes.
    assert found["seconds"] == pytest.approx(PICTURES * (0.25 + 3.0) + 7.0, abs=0.5)
    assert found["cpu_seconds"] == pytest.approx(2 * (PICTURES * (0.25 + 3.0) + 7.0), abs=0.5)
    # Direct light is known from the trials, if there were any.
    assert predict_check(*asked, [], light)["seconds"] == pytest.approx(PICTURES * (100.0 + 3.0) + 7.0, abs=0.5)
    assert predict_check(*asked, tried, None)["seconds"] == pytest.approx(PICTURES * 0.25, abs=0.5)


def test_light_is_measured_before_and_after_receivers_are_traced(config, monkeypatch):
    lit = []

    def exit_radiance(self, *arguments):
        lit.append((arguments[-1], bool(self.gather().start[-1])))
        return original(self, *arguments)

    original = LightingStore.exit_radiance
    monkeypatch.setattr(LightingStore, "exit_radiance", exit_radiance)
    seen = []
    predict = dry.predict_check
    monkeypatch.setattr(dry, "predict_check", lambda *a: seen.append(a[-1]) or predict(*a))
    prepared = prepare(config, Account())
    told = dry.dry_run(prepared, Account(), SETTINGS)
    # Twice without anything traced, of which the first loads kernels, then with some receivers.
    assert [traced for _, traced in lit] == [False] * 8 + [True] * 4
    assert [bounces for bounces, _ in lit] == [2, 2, 0, 2] * 3
    (light,) = seen
    assert light.bounced["cpu_seconds"] > 0.0
    assert told["predicted"]["cpu_seconds"] > PICTURES * light.bounced["cpu_seconds"]

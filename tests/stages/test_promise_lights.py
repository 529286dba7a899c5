"""cluster --tolerance of lights: an epsilon that keeps it, the error under soft lights, and what is said of a miss."""

from __future__ import annotations

import math

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.lights import quadtree
from relightcli.core.measure.errors import relative_rmse
from relightcli.errors import InputError, NumericalError
from relightcli.stages import light_cluster_job, promise_lights
from relightcli.stages.budget import budget
from relightcli.stages.light_clusters import Config, cluster_lights
from relightcli.stages.lighting import LightingStore
from relightcli.stages.measured_error import check_skies
from relightcli.stages.promise_lights import LIGHTS, PLACES, _soft_lights
from tests.core.transport.scenes import lambert, sphere
from tests.stages.scene_files import make_store, write_scene
from tests.stages.test_light_clusters import CAMERA, GOLD, grid, irradiance


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {
        "ground": grid(24, 1.5, material=lambert((0.6, 0.5, 0.4))),
        "ball": sphere(0.4, (-0.3, 0.5, 0), rings=16, material=lambert((0.2, 0.5, 0.7))),
    }
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], {})


@pytest.fixture(scope="module")
def transfer(scene):
    return make_store(scene, light_resolution=32, refine=2, subdivide=False)


def run(store, name, **settings):
    output = store.parent / name
    return cluster_lights(Config(store=store, output=output, quiet=True, resolution=128, **settings)), output


@pytest.mark.parametrize("tolerance", [0.1, 0.05])
def test_tolerance_is_kept_and_not_by_far(transfer, tolerance):
    done, output = run(transfer, f"{tolerance}.zarr", tolerance=tolerance)
    store = formats.open_store(output)
    (spent,) = store.attrs["spent"]
    assert 0.25 * tolerance <= spent["share"] == done["measured_error"] <= tolerance
    check = next(row for row in budget(store) if row["step"] == "check")
    assert check["cpu_seconds"] > 0.0
    assert [error["value"] for error in check["errors"]] == [spent["share"]]
    # What is promised of pictures: even skies and such as are bright about the horizon. Of suns, which are taken apart,
    # the clusters are nearer to the truth than what they were made from.
    for name in ("overcast", "glow", "dusk"):
        sky = check_skies()[name]
        assert relative_rmse(irradiance(output, sky), irradiance(transfer, sky)) <= tolerance


def test_the_error_is_that_of_rays(transfer):
    """Rays to all lights, against the clusters' fractions. Bits of the store say of most receivers whom a light reaches
    that lies between their texels, and of few wrongly: they are 2.8 degrees wide."""
    done, output = run(transfer, "rays.zarr", tolerance=0.5, epsilon=0.2)
    store, lighting = formats.open_store(output), LightingStore(transfer, 1)
    d = _soft_lights(0)
    assert len(d) == PLACES * LIGHTS
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, rtol=1e-12)
    middle = d.reshape(PLACES, LIGHTS, 3).mean(axis=1)
    assert np.einsum("plk,pk->pl", d.reshape(PLACES, LIGHTS, 3), middle).min() > math.cos(math.radians(20.0))
    cells = store.read("light_clusters/cell")
    leaf = quadtree.leaves_at(quadtree.build_tree([tuple(c) for c in cells.tolist()], 128), d)
    fraction, area = store.read("light_clusters/fraction") / 255.0, store.read("light_clusters/area")
    radius = 0.5 * np.sqrt(quadtree.solid_angles(cells, 128))[leaf][:, None]
    tracer = Tracer(lighting.geometry.positions, lighting.geometry.faces)
    origin = tracer.offset(lighting.position, lighting.normal)
    free = [~tracer.occluded(origin, np.tile(w.astype(np.float32), (len(origin), 1))) for w in d]
    height = d @ lighting.normal.astype(float).T
    spread = np.maximum(height + radius, 0.0) ** 2 / (4.0 * radius)
    ours = fraction[leaf] * np.where(height >= radius, height, spread)
    true = np.array(free) * np.maximum(height, 0.0)
    reflectance = store.read("light_clusters/reflectance")
    by_place = [(v * reflectance).reshape(PLACES, LIGHTS, -1).sum(axis=1) for v in (ours - true, true)]
    off, whole = ((v**2 @ area).sum() for v in by_place)
    assert done["measured_error"] == pytest.approx(np.sqrt(off / whole), rel=0.03)


def test_lobes_that_clusters_hold_are_in_it(tmp_path, monkeypatch):
    parts = {"gold": sphere(0.4, (0, 0.4, 0), rings=12, material=GOLD), "ground": grid(8, 1.0, material=lambert(0.3))}
    path = write_scene(tmp_path, parts, [CAMERA], {})
    store = make_store(path, light_resolution=16, refine=2, subdivide=False)
    asked = {"tolerance": 0.9, "epsilon": 0.25, "camera": "main"}
    share = run(store, "kept.zarr", **asked)[0]["measured_error"]
    mean = light_cluster_job._Lobes.mean

    def dark(*arguments):
        steps, scale = mean(*arguments)
        return np.zeros_like(steps), scale

    monkeypatch.setattr(light_cluster_job._Lobes, "mean", dark)
    # Gold has more light in its lobe than all has without: half of it would be 0.5.
    without = run(store, "dark.zarr", **asked)[0]["measured_error"]
    assert without > 0.5
    assert share < 0.6 * without


def test_a_miss_is_told_and_may_be_allowed(transfer):
    with pytest.raises(NumericalError, match=r"more than the 1\.00% that are left .*--epsilon 0\.\d+.*--allow-miss"):
        run(transfer, "miss.zarr", tolerance=0.01, epsilon=0.3)
    assert not (transfer.parent / "miss.zarr").exists()
    done, _ = run(transfer, "miss.zarr", tolerance=0.01, epsilon=0.3, allow_miss=True)
    assert done["status"] == "resumed"
    assert done["measured_error"] > 0.01
    with pytest.raises(NumericalError, match=r"What would help: more --lights"):
        run(transfer, "few.zarr", tolerance=0.01, lights=30)


def test_what_precompute_has_left_is_kept(scene):
    store = make_store(scene, "promised.zarr", light_resolution=32, refine=2, subdivide=False, tolerance=0.3)
    measured = formats.open_store(store).attrs["measured_error"]["share"]
    left = math.sqrt(0.3**2 - measured**2)
    done, output = run(store, "default.zarr")
    settings = formats.open_store(output).settings
    assert settings["lights_tolerance"] == 0.3
    assert settings["epsilon"] == pytest.approx(math.sqrt(left / promise_lights.SHARE))
    assert done["measured_error"] <= left
    assert "measured_error" not in run(store, "paper.zarr", criterion="paper", epsilon=1e-3)[0]


def test_what_is_refused(transfer):
    with pytest.raises(InputError, match="--tolerance: expected more than 0"):
        run(transfer, "t.zarr", tolerance=1.5)
    with pytest.raises(InputError, match="--criterion rms"):
        run(transfer, "t.zarr", tolerance=0.1, criterion="paper")

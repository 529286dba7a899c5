"""Every stage that is made of blocks, on a Dask cluster: the same result as here."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.images import read_image
from relightcli.scene.model import Camera
from relightcli.stages.light_clusters import Config as ClusterConfig
from relightcli.stages.light_clusters import cluster_lights
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import lambert, sphere, square
from tests.run.cluster import Cluster
from tests.stages.scene_files import make_store, write_scene

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'relightcli[cluster]'")
SHELLS = {"field_shells": 3, "field_resolution": 4, "field_proxies": 2, "field_order": 2}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    cluster.heal()
    yield cluster.address
    cluster.close()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {
        "ground": square(3, material=lambert(0.5)),
        "ball": sphere(0.5, (0, 0.6, 0), rings=4, material=lambert(0.7)),
    }
    sky = np.random.default_rng(5).random((8, 16, 3))
    camera = Camera("main", (0, 1.5, 4), (0, 0.5, 0), size=(8, 6))
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [camera], {"sky": sky})


@pytest.fixture(scope="module")
def store(scene):
    return make_store(scene, light_resolution=16, subdivide=False, bounces=0)


def test_light_clusters(store, address):
    found = []
    for name, where in (("here.zarr", None), ("there.zarr", address)):
        output = store.with_name(name)
        cluster_lights(ClusterConfig(store, output, resolution=32, epsilon=0.2, scheduler=where, quiet=True))
        found.append(formats.open_store(output).fingerprint)
    assert found[0] == found[1]


def test_fields(scene, address):
    text = scene.read_text()
    moving = scene.with_name("moving.toml")
    moving.write_text(text.replace("[objects.ball]", '[objects.ball]\nmotion = "rigid"'))
    settings = {"light_resolution": 16, "subdivide": False, "bounces": 0, **SHELLS}
    here = make_store(moving, "fields.zarr", **settings)
    expected = formats.open_store(here).fingerprint
    there = make_store(moving, "fields.zarr", **settings, scheduler=address, overwrite=True)
    blocks = {block["id"].partition("/")[0] for block in formats.open_store(there).blocks}
    assert {"visibility", "fields"} <= blocks
    assert formats.open_store(there).fingerprint == expected


def test_reference_from_another_folder_than_the_workers(scene, address, monkeypatch):
    monkeypatch.chdir(scene.parent)
    found = []
    for name, where in (("here.exr", None), ("there.exr", address)):
        config = Config(
            store=scene.relative_to(scene.parent),
            output=name,
            env="sky",
            reference=True,
            spp=4,
            scheduler=where,
            quiet=True,
        )
        relight(config)
        found.append(read_image(name).pixels)
    np.testing.assert_array_equal(*found)

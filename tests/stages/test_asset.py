"""Transfer tensors from end to end: clusters, asset, and pictures from it beside those from the transfer store."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.scratch import Scratch
from relightcli.core.brdf.models import pack_materials
from relightcli.core.measure.errors import relative_rmse
from relightcli.core.transport.channels import coefficients
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Camera
from relightcli.stages import asset as asset_stage
from relightcli.stages import cluster, direct_tensors, factorize, family, transfer_setup
from relightcli.stages.lighting import LightingStore
from relightcli.stages.relight import Config, relight
from relightcli.stages.transfer_setup import TransferSetup, coarse_cells
from tests.core.transport.scenes import Part, lambert, sphere, square
from tests.core.transport.test_buried import grid
from tests.stages.scene_files import make_store, read_layers, write_scene
from tests.stages.test_bounces import EDIT, GOLD, LAMP, corner

CAMERA = Camera("main", (0.4, 1.3, 2.6), (0, 0.4, 0), fov=38, size=(64, 48))
CLUSTERS = 12
SHARP = ("gold.roughness=0.01",)
MATTE = ("gold.specular=0,0,0",)


def ground(cells, material):
    """A square of 3 x 3 in the xz plane that faces up, in cells."""
    corners, triangles = grid((-1.5, 0, 1.5), (3, 0, 0), (0, 0, -3), cells)
    return Part(corners, triangles, np.tile([0.0, 1.0, 0.0], (len(corners), 1)), material=material)


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    tiles = np.kron(np.array([[0, 1], [1, 0]]), np.ones((4, 4)))[..., None] * [0.8, 0.3, 0.2] + 0.1
    parts = {
        "ground": ground(24, lambert((0.6, 0.5, 0.4))),
        "wall": corner(lambert(1.0), tiles),
        "ball": sphere(0.4, (-0.5, 0.42, 0), rings=16, material=lambert((0.2, 0.5, 0.7))),
        "gold": sphere(0.35, (0.45, 0.36, 0.1), rings=16, material=GOLD),
    }
    height, width = np.mgrid[0:16, 0:32]
    smooth = (1.0 + 0.5 * np.sin(width / 5.0))[..., None] * [0.7, 0.9, 1.2] * (1.5 - height / 16.0)[..., None]
    sunny = np.kron(smooth, np.ones((16, 16, 1)))
    sunny[60:62, 200:202] = 2e4
    maps = {
        "smooth": smooth,
        "sunny": sunny,
        "patchy": np.kron(np.random.default_rng(0).random((8, 16, 3)) ** 3, np.ones((4, 4, 1))),
    }
    folder = tmp_path_factory.mktemp("scene")
    scene = write_scene(folder, parts, [CAMERA], maps, adjustable=True, more=LAMP)
    return make_store(scene, workers=2, bounces=2, light_resolution=32, bounce_resolution=8, subdivide=False)


@pytest.fixture(scope="module")
def clusters(transfer):
    output = transfer.parent / "clusters.zarr"
    said = cluster.cluster(cluster.Config(transfer, output, CLUSTERS, workers=2))
    assert said["light_error"] < 0.03
    return output


@pytest.fixture(scope="module")
def asset(clusters):
    output = clusters.parent / "asset.zarr"
    factorize.factorize(factorize.Config(clusters, output, workers=2))
    return output


def test_arrays_that_outgrow_memory_change_nothing(transfer, clusters, asset, tmp_path, monkeypatch):
    given = []

    class Small(Scratch):
        def __init__(self, folder):
            super().__init__(folder, limit=0, pages=0)
            given.append(self)

        def let_go(self):
            assert self.used
            super().let_go()

    monkeypatch.setattr(transfer_setup, "Scratch", Small)
    monkeypatch.setattr(transfer_setup, "IN_MEMORY", 0)
    monkeypatch.setattr(transfer_setup, "TOUCHED", 1 << 24)  # receivers come by a few
    cluster.cluster(cluster.Config(transfer, tmp_path / "clusters.zarr", CLUSTERS, workers=2))
    factorize.factorize(factorize.Config(clusters, tmp_path / "asset.zarr", workers=2))
    for expected in (clusters, asset):
        ours, theirs = formats.open_store(tmp_path / expected.name), formats.open_store(expected)
        for name in theirs.names():
            np.testing.assert_array_equal(ours.read(name), theirs.read(name), err_msg=name)
    assert len(given) == 2


def layers_of(store, name, **settings):
    output = store.parent / name
    settings = {"env": "smooth", "workers": 2, "layers": True, **settings}
    relight(Config(store=store, output=str(output), quiet=True, **settings))
    return read_layers(output)


@pytest.mark.parametrize("edit", [(), EDIT], ids=["as it is", "edited"])
def test_an_asset_that_memory_need_not_hold(asset, edit, monkeypatch):
    whole = layers_of(asset, "whole.exr", settings=edit)
    read, original = [], family.Parts._read
    monkeypatch.setattr(family.Parts, "_read", lambda self, rows: read.append(rows) or original(self, rows))
    monkeypatch.setattr(family, "IN_MEMORY", 0)
    monkeypatch.setattr(family, "STREAMED", 500)
    monkeypatch.setattr(asset_stage, "TURNED", 300)
    parts = layers_of(asset, "parts.exr", settings=edit)
    assert max(rows.stop - rows.start for rows in read) == 500
    for name, values in whole.items():
        np.testing.assert_array_equal(parts[name], values, err_msg=name)


@pytest.mark.parametrize("edit", [(), EDIT, MATTE], ids=["as it is", "edited", "matte"])
@pytest.mark.parametrize("env", ["smooth", "patchy"])
def test_pictures_of_the_asset_beside_those_of_the_transfer_store(transfer, asset, edit, env):
    # Measured: picture 0.5 to 0.8 %, one bounce 3 to 6 %, two bounces 9 to 26 % (a uniform value under coarse light).
    a = layers_of(transfer, "a.exr", settings=edit, env=env)
    b = layers_of(asset, "b.exr", settings=edit, env=env, basis="visibility")
    assert set(a) == set(b)
    for name in ("direct", "specular"):
        np.testing.assert_array_equal(a[name], b[name])
    assert relative_rmse(b[""], a[""]) < 0.015
    assert relative_rmse(b["one_bounce"], a["one_bounce"]) < 0.09
    np.testing.assert_allclose(b["one_bounce"].mean((0, 1)), a["one_bounce"].mean((0, 1)), rtol=0.03)
    np.testing.assert_allclose(b["two_bounce"].mean((0, 1)), a["two_bounce"].mean((0, 1)), rtol=0.2)
    parts = sum(b[name] for name in ("direct", "specular", "one_bounce", "two_bounce"))
    np.testing.assert_allclose(parts, b[""], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("env", ["smooth", "sunny"])
@pytest.mark.parametrize("edit", [(), EDIT, SHARP], ids=["as it is", "edited", "sharp"])
def test_direct_light_from_tensors(transfer, asset, edit, env):
    a, b = (
        layers["direct"] + layers["specular"]
        for layers in (
            layers_of(transfer, "a.exr", settings=edit, env=env),
            layers_of(asset, "b.exr", settings=edit, env=env),
        )
    )
    if (edit, env) != (SHARP, "sunny"):  # a sun's mirror image is as wide as a texel
        assert relative_rmse(b, a) < 0.05
    np.testing.assert_allclose(b.mean((0, 1)), a.mean((0, 1)), rtol=0.1 if (edit, env) == (SHARP, "sunny") else 0.02)


def test_tensors_carry_the_energy_of_matte_surfaces(transfer):
    """The mean of one and two bounces, uncompressed, is what receivers gather under even light."""
    lighting = LightingStore(transfer, 2)
    materials = {k: dataclasses.replace(m, specular=(0.0, 0.0, 0.0)) for k, m in lighting.scene.materials.items()}
    setup = TransferSetup(lighting, 4, 2)
    weights = coefficients(setup.channels, pack_materials(list(materials.values())), 4)
    view = np.tile(np.float32([0, 1, 0]), (len(lighting), 1))
    truth = lighting.exit_radiance(np.ones((16, 32, 3), np.float32), 0.0, materials, view)
    rows = np.arange(0, len(lighting), 7)
    lights = setup.sources(coarse_cells())
    even = np.ones((lights.even.shape[1], 3))
    even[-3:] = np.eye(3)  # the lamp's columns are its colours
    albedo = np.array([m.diffuse for m in materials.values()])[setup.material[rows]]
    one = setup.gather_rows(rows, lights, 0)[:, :, 0]
    got = np.einsum("nql,lk,qk->nk", one, even, weights) * albedo
    np.testing.assert_allclose(got, truth[1].diffuse[rows], rtol=0.01, atol=2e-3 * truth[1].diffuse.max())
    second = setup.second_sources(lights, 4)
    two = setup.gather_rows(rows, second, 0)[:, :, 0].reshape(len(rows), setup.count, -1, setup.count)
    got = np.einsum("nalb,lk,ak,bk->nk", two, even, weights, weights) * albedo
    np.testing.assert_allclose(got.mean(0), truth[2].diffuse[rows].mean(0), rtol=0.02)


def recorded(asset, bounce):
    """Relative RMS that an asset's blocks say was left out."""
    blocks = [b for b in formats.open_store(asset).blocks if b["id"].startswith(bounce.replace("_", "-"))]
    return (sum(b["error2"] for b in blocks) / sum(b["norm2"] for b in blocks)) ** 0.5


def test_error_falls_with_rank_and_is_what_was_recorded(clusters, asset, tmp_path):
    left = {}
    for v, rank in ((4, 8), (64, 256)):
        config = factorize.Config(clusters, tmp_path / f"{v}.zarr", v, rank, workers=2)
        left[v] = factorize.factorize(config)["errors"]
    for bounce in ("one_bounce", "two_bounce"):
        totals = [left[4][bounce]["total"], recorded(asset, bounce), left[64][bounce]["total"]]
        assert totals[0] > totals[1] > totals[2]
        assert all(e[bounce]["total"] >= e[bounce]["compression"] * (1 - 1e-6) for e in left.values())
    assert left[64]["two_bounce"]["total"] < 0.01


def test_order_of_changes_does_not_matter(asset, tmp_path):
    """Frames that share what did not change equal pictures made on their own."""
    shots = tmp_path / "shots.toml"
    shots.write_text(
        "format = 1\nframes = 4\n"
        "[[key]]\nframe = 1\nenv_rotate = 0\n"
        "[key.set]\n'gold.roughness' = 0.3\n"
        "[[key]]\nframe = 4\nenv_rotate = 90\n"
        "[key.set]\n'gold.roughness' = 0.6\n"
    )
    pattern = tmp_path / "f.##.exr"
    said = relight(Config(store=asset, output=str(pattern), env="smooth", frames=shots, workers=2, quiet=True))
    last = read_layers(tmp_path / "f.04.exr")
    alone = layers_of(asset, "c.exr", layers=False, env_rotate=90.0, settings=("gold.roughness=0.6",))
    np.testing.assert_allclose(last[""], alone[""], rtol=1e-5, atol=1e-6)
    assert len(said["output"]) == 4


def test_interrupted_work_is_continued_with_the_same_bytes(transfer, clusters, asset, tmp_path, monkeypatch):
    record = formats.Writer.record

    for stage, source, made, blocks in (
        (cluster.cluster, transfer, clusters, ("copy/mesh/face", "light-basis")),
        (factorize.factorize, clusters, asset, ("one-bounce/0", "two-bounce/0")),
    ):
        output = tmp_path / made.name
        if stage is cluster.cluster:
            config = cluster.Config(source, output, CLUSTERS, workers=1)
        else:
            config = factorize.Config(source, output, workers=1)
        for block in blocks:

            def interrupted(self, block_id, info, at=block):
                record(self, block_id, info)
                if block_id == at:
                    raise KeyboardInterrupt

            monkeypatch.setattr(formats.Writer, "record", interrupted)
            with pytest.raises(KeyboardInterrupt):
                stage(config)
        monkeypatch.setattr(formats.Writer, "record", record)
        assert stage(config)["status"] == "resumed"
        a, b = formats.open_store(output), formats.open_store(made)
        assert a.names() == b.names()
        for name in a.names():
            np.testing.assert_array_equal(a.read(name), b.read(name), err_msg=name)
        assert stage(config)["status"] == "up to date"


def test_ranks_of_the_brdf_tensors_are_asked_of_the_models(clusters, tmp_path, monkeypatch):
    asked = []

    def known(name, ranks=None):
        asked.append((name, ranks))
        raise InterruptedError  # to make one takes long

    monkeypatch.setattr(direct_tensors, "direct_model", known)
    config = factorize.Config(clusters, tmp_path / "low.zarr", brdf_ranks=(4, 8, 8), quiet=True, workers=2)
    with pytest.raises(InterruptedError):
        factorize.factorize(config)
    assert asked == [("cook-torrance", (4, 8, 8))]
    assert json.loads((tmp_path / "low.zarr.partial/zarr.json").read_text())["attributes"]["relight"]["settings"][
        "brdf_ranks"
    ] == [4, 8, 8]


def test_every_stage_can_be_path_traced(transfer, clusters, asset):
    options = {"reference": True, "spp": 4, "bounces": 1}
    truth = layers_of(transfer, "ref-t.exr", **options)
    for store in (clusters, asset):
        found = layers_of(store, f"ref-{store.stem}.exr", **options)
        assert found.keys() == truth.keys()
        for name in truth:  # the same scene and the same random numbers
            np.testing.assert_array_equal(found[name], truth[name], err_msg=name)


def test_refusals_name_the_way_out(transfer, clusters, asset, tmp_path):
    with pytest.raises(StoreError, match="run cluster first"):
        factorize.factorize(factorize.Config(transfer, tmp_path / "x.zarr"))
    with pytest.raises(StoreError, match="expected a store of kind transfer"):
        cluster.cluster(cluster.Config(clusters, tmp_path / "x.zarr"))
    with pytest.raises(StoreError, match="--bounces 3"):
        layers_of(asset, "x.exr", bounces=3)
    with pytest.raises(InputError, match="was made for lambert"):
        layers_of(asset, "x.exr", settings=("ball=gold-paint",))


def test_a_store_of_direct_light_is_refused(tmp_path):
    scene = write_scene(tmp_path, {"ground": square(1)}, [CAMERA], {"smooth": np.ones((4, 8, 3))})
    store = make_store(scene, workers=1)
    with pytest.raises(StoreError, match="precompute with --bounces"):
        cluster.cluster(cluster.Config(store, tmp_path / "c.zarr"))

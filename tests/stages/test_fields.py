"""Fields in a store: the same bytes however they come about, shared, kept in a library; and what static things see."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.build import build_field
from relightcli.errors import InputError, StoreError
from relightcli.run import blocks as run
from relightcli.scene.bodies import own_frame
from relightcli.scene.model import Camera
from relightcli.scene.parse import load_scene
from relightcli.stages import field_store
from relightcli.stages.cluster import Config as ClusterConfig
from relightcli.stages.cluster import cluster
from relightcli.stages.field_store import read_field, read_source
from relightcli.stages.fields import FieldSettings, find_movers
from relightcli.stages.light_clusters import Config as LightConfig
from relightcli.stages.light_clusters import cluster_lights
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, write_scene

CAMERA = Camera("main", (0, 1.5, 3), (0, 0.3, 0), fov=40, size=(16, 12))
SMALL = {"light_resolution": 16, "field_shells": 2, "field_resolution": 2, "field_proxies": 2, "subdivide": False}
LAMP = "[lights.lamp]\nshape = 'sphere'\ncenter = [0, 3, 0]\nradius = 0.2\nradiance = [1, 2, 3]\n"
PLACES = {
    "ball": "translate = [0, 0.6, 0]\nrotate = [1, 2, 3, 40]",
    "again": "translate = [1, 0.6, 0]\nrotate = [0, 1, 0, 10]\nscale = 0.5",
    "block": "translate = [-1, 0.6, 0]\nscale = [1, 2, 1]",
}


def write(folder, more=""):
    """A ground and three rigid balls, two of them alike in their own frames; the third is stretched, and coloured."""
    parts = {"ground": square(4, material=lambert(0.5))}
    parts |= {name: sphere(0.5, rings=6, material=lambert(0.7)) for name in PLACES}
    path = write_scene(folder, parts, [CAMERA], {"white": np.ones((4, 8, 3))}, more=LAMP + more)
    text = path.read_text()
    for name, place in PLACES.items():
        material = "block" if name == "block" else "ball"
        text = text.replace(
            f"mesh = '{name}.obj'\nmaterial = '{name}'",
            f"mesh = '{name}.obj'\nmaterial = '{material}'\nmotion = 'rigid'\n{place}",
        )
    text = text.replace(
        "[materials.block]\nmodel = 'lambert'\ndiffuse = [0.7, 0.7, 0.7]",
        "[materials.block]\ndiffuse = [0.9, 0.2, 0.1]",
    )
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write(tmp_path_factory.mktemp("fields"))


@pytest.fixture(scope="module")
def store(scene):
    return formats.open_store(make_store(scene, **SMALL, bounces=1))


def test_alike_objects_share_a_field(store):
    objects = store.attrs["fields"]["objects"]
    assert [objects[name]["field"] for name in PLACES] == [0, 0, 1]
    assert store.attrs["fields"]["lights"] == {"lamp": {"source": 0}}
    # What they are placed by is their rotation and size alone.
    for name, size in (("ball", 1.0), ("again", 0.5), ("block", 2 ** (1 / 3))):
        linear = np.array(objects[name]["placement"])[:3, :3]
        np.testing.assert_allclose(linear.T @ linear, size**2 * np.eye(3), atol=1e-9)


def test_fields_are_those_of_the_objects_alone(scene, store):
    moving = find_movers(load_scene(scene), FieldSettings(2, 2, 2), False, 0)
    for k, distinct in enumerate(moving.fields):
        field, own = read_field(store, f"fields/{k}/")
        wanted, wanted_own = build_field(
            Tracer(distinct.body.positions, distinct.body.faces), distinct.body, 2, 2, 2, tolerance=0.01
        )
        for name in ("center", "radii", "valid", "proxies", "occlusion", "transfer"):
            np.testing.assert_array_equal(getattr(field, name), getattr(wanted, name), err_msg=name)
        assert (field.radius, field.resolution) == (wanted.radius, wanted.resolution)
        np.testing.assert_array_equal(own.transfer, wanted_own.transfer)
    assert [f.spec.colours for f in moving.fields] == [1, 3]


def test_points_are_receivers_in_the_order_of_their_field(store):
    position, normal = store.read("receivers/position"), store.read("receivers/normal")
    for name, entry in store.attrs["fields"]["objects"].items():
        rows = slice(entry["first"], entry["first"] + entry["count"])
        matrix, prefix = np.array(entry["placement"]), f"fields/{entry['field']}/"
        point = store.read(f"{prefix}point") @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(position[rows], point, atol=1e-12, err_msg=name)
        vertex = store.read("receivers/vertex")[rows]
        np.testing.assert_allclose(store.read("mesh/position")[vertex], point, atol=1e-9)
        np.testing.assert_allclose(store.read("mesh/normal")[vertex], normal[rows], atol=1e-6)
        assert len(set(store.read("receivers/object")[rows])) == 1


def test_static_receivers_do_not_see_what_moves(scene, store, tmp_path):
    """The ground sees the whole sky, though balls hang over it; balls see all that is above their own horizon."""
    bits = np.unpackbits(store.read("visibility/bits").reshape(len(store.read("receivers/side")), -1), axis=1)
    first = min(entry["first"] for entry in store.attrs["fields"]["objects"].values())
    ground = bits[:first].mean(1)
    np.testing.assert_allclose(ground, 0.5, atol=0.02)  # texels of 16 at the horizon
    assert not store.read("bounce/hit")[:first].any()
    together = formats.open_store(make_store(scene, "together.zarr", **SMALL, effects="direct,shadows"))
    assert np.unpackbits(together.read("visibility/bits")).sum() < bits.sum() - 100
    assert "fields" not in together.attrs


def test_lights_have_source_fields(store):
    source = read_source(store, "sources/0/")
    assert (source.radius, source.resolution) == (0.2, 2)
    assert source.radiance.shape == (2, 24, 16, 3)
    np.testing.assert_allclose(source.radiance[..., 1], 2 * source.radiance[..., 0], rtol=1e-6)


def test_the_same_bytes_for_workers_interruptions_and_libraries(scene, store, tmp_path, monkeypatch):
    two = make_store(scene, "two.zarr", **SMALL, bounces=1, workers=2)
    assert formats.open_store(two).fingerprint == store.fingerprint

    monkeypatch.setattr(field_store.FieldSpec, "block", property(lambda spec: 7))
    original, left = field_store.SampleWorker.run, [3]

    def stopping(worker, block):
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return original(worker, block)

    with monkeypatch.context() as patch:
        patch.setattr(field_store.SampleWorker, "run", stopping)
        with pytest.raises(KeyboardInterrupt):
            make_store(scene, "resumed.zarr", **SMALL, bounces=1)
    run.close_worker()
    traced = []
    monkeypatch.setattr(field_store.SelfWorker, "run", lambda worker, block: traced.append(block))
    resumed = formats.open_store(make_store(scene, "resumed.zarr", **SMALL, bounces=1))
    assert not traced  # the self transfer was there
    for name in ("transfer", "occlusion", "valid"):
        np.testing.assert_array_equal(resumed.read(f"fields/1/{name}"), store.read(f"fields/1/{name}"))


def test_a_library_is_filled_once_and_used_by_other_scenes(scene, store, tmp_path, monkeypatch):
    library = tmp_path / "library"
    kept = formats.open_store(make_store(scene, "kept.zarr", **SMALL, bounces=1, field_library=library))
    assert kept.fingerprint == store.fingerprint
    assert len(list(library.glob("*.zarr"))) == 2
    field, _ = read_field(formats.open_store(sorted(library.glob("*.zarr"))[0], "field"))
    assert field.transfer.shape[:3] == (2, 24, 2)

    def refuse(worker, block):
        raise AssertionError("simulated again")

    monkeypatch.setattr(field_store.SampleWorker, "run", refuse)
    monkeypatch.setattr(field_store.SelfWorker, "run", refuse)
    other = write(tmp_path / "other")
    other.write_text(other.read_text().replace("translate = [0, 0.6, 0]", "translate = [0, 0.9, 0.3]"))
    again = formats.open_store(make_store(other, **SMALL, field_library=library))
    np.testing.assert_array_equal(again.read("fields/0/transfer"), store.read("fields/0/transfer"))


def test_own_frames_leave_place_rotation_and_size_to_the_placement():
    rng = np.random.default_rng(0)
    matrix = np.eye(4)
    matrix[:3] = rng.standard_normal((3, 4))
    shape, placement = own_frame(matrix)
    np.testing.assert_allclose(placement @ shape, matrix, atol=1e-14)
    assert abs(np.linalg.det(shape)) == pytest.approx(1.0, abs=1e-10)
    linear = placement[:3, :3]
    size = np.cbrt(np.linalg.det(linear))
    assert size > 0
    np.testing.assert_allclose(linear.T @ linear, size**2 * np.eye(3), atol=1e-10)
    np.testing.assert_array_equal(own_frame(np.diag([3.0, 3, 3, 1]))[0], np.eye(4))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"field_shells": 1}, "--field-shells: expected 2 to 256; found 1"),
        ({"field_resolution": 0}, "--field-resolution: expected 1 to 128; found 0"),
        ({"field_resolution": 129}, "--field-resolution: expected 1 to 128; found 129"),
        ({"field_proxies": 0}, "--field-proxies: expected 1 to 256; found 0"),
        ({"field_order": 9}, "--field-order: expected 1 to 8; found 9"),
        ({"receivers": "pixels:main"}, "--receivers: objects that move"),
    ],
)
def test_refusals(scene, settings, message):
    with pytest.raises(InputError, match=message):
        make_store(scene, "refused.zarr", **{**SMALL, **settings})


def test_membranes_that_move_are_refused(tmp_path):
    path = write(tmp_path)
    path.write_text(path.read_text().replace("[materials.block]\n", "[materials.block]\nmodel = 'translucent'\n"))
    with pytest.raises(InputError, match=r"objects.block: expected .* 'block' is translucent"):
        make_store(path, **SMALL)


def test_dry_run_counts_the_rays_of_fields(scene):
    from relightcli.stages.precompute import precompute
    from relightcli.stages.precompute_config import Config

    config = Config(scene=scene, output=scene.parent / "no.zarr", **SMALL, dry_run=True, quiet=True)
    found = precompute(config)
    assert found["predicted"]["rays"] >= 2 * 2 * 24 * 1024
    assert {d["effect"]: d["simulate"] for d in found["plan"]}["fields"]


def test_clustering_takes_nothing_that_moves(store):
    output = store.path.with_name("clusters.zarr")
    for stage, settings in ((cluster, {}), (cluster_lights, {"resolution": 16})):
        config = {cluster: ClusterConfig, cluster_lights: LightConfig}[stage]
        with pytest.raises(StoreError, match="objects that may be moved"):
            stage(config(store=store.path, output=output, quiet=True, **settings))

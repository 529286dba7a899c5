"""Fields in a store: the same bytes however they come about, shared, kept in a library; and what static things see."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.fields.body import diffuse_operator, make_body
from relightcli.core.fields.build import build_field
from relightcli.errors import InputError, StoreError
from relightcli.run import blocks as run
from relightcli.scene.bodies import own_frame
from relightcli.scene.model import Camera, Material
from relightcli.scene.parse import load_scene
from relightcli.stages import field_job
from relightcli.stages.cluster import Config as ClusterConfig
from relightcli.stages.cluster import cluster
from relightcli.stages.field_store import read_field, read_source
from relightcli.stages.fields import FieldSettings, find_movers
from relightcli.stages.inspect import inspect
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
        field = read_field(store, f"fields/{k}/")
        wanted, wanted_own = build_field(
            Tracer(distinct.body.positions, distinct.body.faces), distinct.body, 2, 2, 2, tolerance=0.01
        )
        for name in ("radii", "valid", "proxies"):
            np.testing.assert_array_equal(getattr(field, name), getattr(wanted, name), err_msg=name)
        assert field.resolution == wanted.resolution
        for s, (ours, truth) in enumerate(zip(field.occlusion.reshape(2, 24, 16), wanted.occlusion, strict=True)):
            even = np.eye(1, 16)[0] * np.sqrt(4 * np.pi)
            step = np.abs(even - truth).max(axis=0) / 2047
            assert (np.abs(ours - truth) <= 0.5 * step + 1e-6).all(), s
        transfer = wanted.transfer.reshape(-1, *wanted.transfer.shape[2:])
        missing = np.linalg.norm(field.transfer.decompress() - transfer) / np.linalg.norm(transfer)
        assert missing == pytest.approx(field.transfer.error, rel=1e-3)
        assert 0.001 < missing <= 0.0101  # 1 % of leeway: rounding errors are counted as evenly spread
        whole = wanted_own.transfer.sum(1, dtype=np.float64)
        diffuse = np.einsum("pi,pijc->pjc", diffuse_operator(distinct.body), whole)
        opened, once, rest = np.split(field.self_by_order, [1, 1 + distinct.body.colours], axis=2)
        step = np.abs(diffuse).max() / 32767  # three parts, each off by half a step
        np.testing.assert_allclose(opened + once + rest, diffuse, atol=1.5 * step * 1.001)
        assert field.self_whole is None
    assert [f.spec.colours for f in moving.fields] == [1, 3]


def test_points_are_receivers_in_the_order_of_their_field(store):
    position, normal = store.read("receivers/position"), store.read("receivers/normal")
    for name, entry in store.attrs["fields"]["objects"].items():
        rows = slice(entry["first"], entry["first"] + entry["count"])
        matrix = np.array(entry["placement"])
        mesh = [store.read(f"fields/{entry['field']}/mesh/{part}") for part in ("position", "normal", "face")]
        body = make_body(*mesh, False, np.ones((len(mesh[0]), 3)), Material("any"), 1)
        point = body.point @ matrix[:3, :3].T + matrix[:3, 3]
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


def test_inspect_says_how_large_fields_are_and_how_far_off(store):
    found = inspect(store.path, verify=True)
    assert found["problems"] == []
    assert [f["objects"] for f in found["fields"]] == [["again", "ball"], ["block"]]
    for k, entry in enumerate(found["fields"]):
        assert entry["error"] == read_field(store, f"fields/{k}/").transfer.error
        assert entry["tolerance"] == 0.01
        assert entry["transfer_raw_bytes"] == 4 * 48 * 2 * 16 * 16 * (1, 3)[k]
        own = [name for name in found["arrays"] if name.startswith(f"fields/{k}/")]
        assert entry["bytes"] == sum(found["arrays"][name]["bytes"] for name in own) > entry["transfer_bytes"]
    assert not any("/work/" in name for name in found["arrays"])


def test_glossy_objects_keep_their_self_transfer(scene, tmp_path):
    path = write(tmp_path)
    text = path.read_text().replace(
        "[materials.block]\n", "[materials.block]\nmodel = 'blinn-phong'\nshininess = 5\nspecular = [0.3, 0.3, 0.3]\n"
    )
    path.write_text(text)
    made = formats.open_store(make_store(path, **SMALL))
    body = find_movers(load_scene(path), FieldSettings(2, 2, 2), False, 0).fields[1].body
    _, own = build_field(Tracer(body.positions, body.faces), body, 2, 2, 2, tolerance=0.01)
    whole = own.transfer.sum(axis=1)
    field = read_field(made, "fields/1/")
    assert np.linalg.norm(field.self_whole - whole) <= 0.0101 * np.linalg.norm(whole)  # half the transfer's tolerance
    assert field.transfer.error <= 0.0202


def test_lights_have_source_fields(store):
    source = read_source(store, "sources/0/")
    assert (source.radius, source.resolution) == (0.2, 2)
    assert source.radiance.shape == (2, 24, 16, 3)
    np.testing.assert_allclose(source.radiance[..., 1], 2 * source.radiance[..., 0], rtol=1e-6)


def test_the_same_bytes_for_workers_interruptions_and_libraries(scene, store, tmp_path, monkeypatch):
    two = make_store(scene, "two.zarr", **SMALL, bounces=1, workers=2)
    assert formats.open_store(two).fingerprint == store.fingerprint

    monkeypatch.setattr(field_job.FieldSpec, "block", property(lambda spec: 7))
    original, left = field_job.SampleWorker.run, [3]

    def stopping(worker, block):
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return original(worker, block)

    with monkeypatch.context() as patch:
        patch.setattr(field_job.SampleWorker, "run", stopping)
        with pytest.raises(KeyboardInterrupt):
            make_store(scene, "resumed.zarr", **SMALL, bounces=1)
    run.close_worker()
    traced = []
    monkeypatch.setattr(field_job.SelfWorker, "run", lambda worker, block: traced.append(block))
    resumed = formats.open_store(make_store(scene, "resumed.zarr", **SMALL, bounces=1))
    assert not traced  # the self transfer was there
    for name in ("transfer/component", "transfer/coefficient", "hidden", "valid", "self"):
        np.testing.assert_array_equal(resumed.read(f"fields/1/{name}"), store.read(f"fields/1/{name}"))


def test_a_crash_before_the_work_is_cleared_leaves_nothing_behind(scene, store, monkeypatch):
    def dying(writer, name):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(formats.Writer, "drop", dying)
        with pytest.raises(KeyboardInterrupt):
            make_store(scene, "cleared.zarr", **SMALL, bounces=1)
    assert (scene.parent / "cleared.zarr.partial/fields/0/work").is_dir()
    assert formats.open_store(make_store(scene, "cleared.zarr", **SMALL, bounces=1)).fingerprint == store.fingerprint


def test_a_library_is_filled_once_and_used_by_other_scenes(scene, store, tmp_path, monkeypatch):
    library = tmp_path / "library"
    kept = formats.open_store(make_store(scene, "kept.zarr", **SMALL, bounces=1, field_library=library))
    assert kept.fingerprint == store.fingerprint
    assert len(list(library.glob("*.zarr"))) == 2
    field = read_field(formats.open_store(sorted(library.glob("*.zarr"))[0], "field"))
    assert field.transfer.decompress().shape[:2] == (2 * 24, 2)

    def refuse(worker, block):
        raise AssertionError("simulated again")

    monkeypatch.setattr(field_job.SampleWorker, "run", refuse)
    monkeypatch.setattr(field_job.SelfWorker, "run", refuse)
    other = write(tmp_path / "other")
    other.write_text(other.read_text().replace("translate = [0, 0.6, 0]", "translate = [0, 0.9, 0.3]"))
    again = formats.open_store(make_store(other, **SMALL, field_library=library))
    for name in ("component", "coefficient"):
        found, wanted = (s.read(f"fields/0/transfer/{name}") for s in (again, store))
        np.testing.assert_array_equal(found, wanted)


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
        ({"field_tolerance": 0.0}, "--field-tolerance: expected 0.001 to 0.5; found 0.0"),
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


def test_fields_of_an_earlier_form_are_refused():
    old = SimpleNamespace(
        path="old.zarr", read=None, layouts={"self": SimpleNamespace(dims=("byte", "point", "harmonic"))}
    )
    with pytest.raises(StoreError, match=r"old\.zarr: .*earlier form"):
        read_field(old)

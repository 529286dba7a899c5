"""Skinned objects from the scene file to the transfer store, and their poses in references."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.pose.rig import posed
from relightcli.core.sphere.sh import harmonics
from relightcli.core.transport.tessellation import tessellate
from relightcli.errors import InputError, StoreError
from relightcli.run import blocks as run
from relightcli.scene.build import build_geometry
from relightcli.scene.parse import load_scene
from relightcli.scene.posing import apply_poses
from relightcli.stages.fit_pose import Config as FitConfig
from relightcli.stages.fit_pose import fit_pose
from relightcli.stages.inspect import inspect
from relightcli.stages.lighting import read_scene
from relightcli.stages.pose_job import PoseWorker
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.stages.pose_files import SCENE, pose_scene
from tests.stages.scene_files import make_store, picture

SMALL = {"light_resolution": 16, "pose_directions": 256, "subdivide": False, "bounces": 0}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return pose_scene(tmp_path_factory.mktemp("poses"))


@pytest.fixture(scope="module")
def store(scene):
    return make_store(scene, **SMALL)


def render(source, output, **settings):
    defaults = {"spp": 16, "workers": 1, "quiet": True, "reference": True}
    relight(RelightConfig(store=source, output=str(output), **{**defaults, **settings}))
    return output


def test_the_store_holds_scene_and_rig(scene, store):
    loaded, geometry = read_scene(formats.open_store(store))
    fresh = build_geometry(load_scene(scene))
    assert list(geometry.rigs) == ["bar"]
    rig, original = geometry.rigs["bar"], fresh.rigs["bar"]
    assert rig.node_names == original.node_names
    assert [c.name for c in rig.clips] == ["bend", "still"]
    for clip, before in zip(rig.clips, original.clips, strict=True):
        for seconds in (0.0, 0.7, 3.0):
            found = posed(rig, loaded.objects["bar"].transform, clip, seconds)
            for a, b in zip(found, posed(original, loaded.objects["bar"].transform, before, seconds), strict=True):
                assert np.array_equal(a, b)
    assert np.array_equal(geometry.positions, fresh.positions)


def test_what_moves_is_not_cut(scene):
    whole = build_geometry(load_scene(scene))
    cut = tessellate(whole)
    assert (cut.vertex_object == 1).sum() > 100
    assert np.array_equal(cut.positions[cut.vertex_object == 0], whole.positions[whole.vertex_object == 0])
    assert np.array_equal(cut.faces[cut.face_object == 0], whole.faces[whole.face_object == 0])


def test_a_reference_of_the_store_is_that_of_the_scene_file(scene, store, tmp_path):
    one = render(scene, tmp_path / "scene.exr", poses=("bar=bend@1.3",))
    other = render(store, tmp_path / "store.exr", poses=("bar=bend@1.3",))
    a, b = picture_of(one), picture_of(other)
    assert np.array_equal(a, b)
    rest = picture_of(render(store, tmp_path / "rest.exr"))
    assert np.abs(a - rest).max() > 0.1


def picture_of(path):
    from relightcli.adapters.images import read_image

    return read_image(path).pixels[..., :3]


def test_a_posed_reference_is_that_of_the_posed_mesh(scene, tmp_path):
    loaded = load_scene(scene)
    geometry, _ = apply_poses(loaded, build_geometry(loaded), ["bar=bend@1.7"])
    own, faces = geometry.vertex_object == 0, geometry.faces[geometry.face_object == 0] + 1
    lines = ["v " + " ".join(map(repr, v)) for v in geometry.positions[own].tolist()]
    lines += ["vn " + " ".join(map(repr, v)) for v in geometry.normals[own].astype(float).tolist()]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in faces.tolist()]
    still = SCENE.replace("bar.glb", "bar.obj").replace('motion = "skinned"\ntranslate = [0, 0.1, 0]\n', "")
    other = pose_scene(tmp_path / "still", still)
    (other.parent / "bar.obj").write_text("\n".join(lines) + "\n")
    a = picture_of(render(scene, tmp_path / "a.exr", poses=("bar=bend@1.7",)))
    b = picture_of(render(other, tmp_path / "b.exr"))
    assert np.abs(a - b).max() < 1e-4  # the same paths, but for rounding


def test_poses_in_keyframes(scene, tmp_path):
    (tmp_path / "shots.toml").write_text(
        "format = 1\nframes = 3\n[[key]]\nframe = 1\npose = { bar = 'bend@0' }\n"
        "[[key]]\nframe = 3\npose = { bar = 'bend@2' }\n"
    )
    render(scene, tmp_path / "f.##.exr", frames=tmp_path / "shots.toml")
    middle = picture_of(render(scene, tmp_path / "one.exr", poses=("bar=bend@1",)))
    assert np.array_equal(picture_of(tmp_path / "f.02.exr"), middle)
    assert not np.array_equal(picture_of(tmp_path / "f.03.exr"), middle)
    (tmp_path / "shots.toml").write_text("format = 1\nframes = 3\n[[key]]\nframe = 1\npose = { bar = 'bent@0' }\n")
    with pytest.raises(InputError, match=r"shots.toml: frame 1: .*no clip 'bent'"):
        render(scene, tmp_path / "f.##.exr", frames=tmp_path / "shots.toml")


def test_a_transfer_store_is_posed_by_references_alone(store, tmp_path):
    with pytest.raises(InputError, match=r"--pose: .*add --reference"):
        relight(RelightConfig(store=store, output=str(tmp_path / "a.exr"), quiet=True, poses=("bar=bend@1",)))


def test_what_blocks_nothing_for_others(scene, store):
    # The floor sees no bar, which will stand elsewhere: it is as bright as without one. The bar sees itself.
    read = formats.open_store(store).read
    on_floor = (read("receivers/object") == 1) & (read("receivers/side") == 1)
    bits = np.unpackbits(read("visibility/bits").reshape(len(on_floor), -1), axis=1)
    assert bits[on_floor].sum(axis=1).min() == bits[on_floor].sum(axis=1).max()
    shown = make_store(scene, "rest.zarr", effects="direct,shadows", light_resolution=16, subdivide=False, bounces=0)
    other = formats.open_store(shown)
    all_bits = np.unpackbits(other.read("visibility/bits").reshape(len(on_floor), -1), axis=1)
    assert np.array_equal(bits[~on_floor], all_bits[~on_floor])
    assert (bits[on_floor] > all_bits[on_floor]).any()
    assert "poses" not in other.attrs
    assert "bar" in read_scene(other)[1].rigs  # posed by references all the same


def test_what_vertices_see_is_what_rays_say(store):
    opened = formats.open_store(store)
    clip, seconds = opened.read("pose/0/clip"), opened.read("pose/0/seconds")
    assert clip.tolist() == [0] * 5 + [1]
    assert opened.read("pose/0/features")[:, 2] == pytest.approx(np.radians([0, 30, 60, 90, 120, 60]), abs=1e-6)
    assert opened.attrs["poses"]["0"]["features"][2] == "high.rotation.z"
    scene, geometry = read_scene(opened)
    rig, own = geometry.rigs["bar"], geometry.faces[geometry.face_object == 0]
    position, normal, tangent = posed(rig, scene.objects["bar"].transform, rig.clips[0], seconds[4])
    matrix = opened.read("pose/0/joint_matrix")[4]
    assert np.allclose((matrix[0, :3, :3] @ rig.position[0]) + matrix[0, :3, 3], position[0], atol=1e-12)
    # Random directions over the sphere, brute force, with a noise that falls as n^(-1/2).
    rays = 20_000
    world = np.random.default_rng(3).normal(size=(rays, 3))
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    tracer = Tracer(position, own)
    found = opened.read("pose/0/visibility")[4]
    assert np.ptp(found, axis=0).max() > 0.5
    for v in range(0, len(position), 3):
        frame = np.stack([tangent[v], np.cross(normal[v], tangent[v]), normal[v]])
        above = world[world @ normal[v] > 0]
        origins = np.repeat(tracer.offset(position[v : v + 1], normal[v : v + 1]), len(above), axis=0)
        free = above[~tracer.occluded(origins, above.astype(np.float32))]
        expected = 4 * np.pi / rays * harmonics(free @ frame.T, 4).sum(axis=0)
        # Five standard deviations of 4 pi / sqrt(rays) times an RMS of 1 / sqrt(4 pi), and the lattice's 2 %.
        assert np.abs(found[v] - expected).max() < 5 * np.sqrt(4 * np.pi / rays) + 0.02 * np.sqrt(2 * np.pi)


def test_surroundings_block_when_asked(scene, store):
    with_floor = formats.open_store(make_store(scene, "floor.zarr", **SMALL, pose_surroundings=True))
    alone, beside = formats.open_store(store).read("pose/0/visibility"), with_floor.read("pose/0/visibility")
    assert (beside[..., 0] <= alone[..., 0] + 1e-6).all()
    assert (beside[..., 0] < 0.7 * alone[..., 0]).any()  # the floor takes half of a wall's sky


def test_frames_and_order_are_knobs(scene):
    opened = formats.open_store(make_store(scene, "few.zarr", **SMALL, pose_frames="every:2", pose_order=2))
    assert opened.read("pose/0/seconds").tolist() == [0, 1, 2, 0]
    assert opened.read("pose/0/visibility").shape == (4, 40, 4)
    opened = formats.open_store(make_store(scene, "spread.zarr", **SMALL, pose_frames="spread:2"))
    assert len(opened.read("pose/0/seconds")) == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pose_frames": "some"}, "--pose-frames: expected all, every:N or spread:N"),
        ({"pose_frames": "every:0"}, "found 'every:0'"),
        ({"pose_frames": "all:3"}, "found 'all:3'"),
        ({"pose_order": 9}, "--pose-order: expected 1 to 8; found 9"),
        ({"pose_directions": 3}, "--pose-directions: expected 16"),
    ],
)
def test_knobs_that_do_not_fit(scene, settings, message):
    with pytest.raises(InputError, match=message):
        make_store(scene, "never.zarr", bounces=0, **settings)


def test_same_bytes_for_two_workers_and_after_an_interruption(scene, store, monkeypatch):
    two = make_store(scene, "two.zarr", **SMALL, workers=2)
    original, left = PoseWorker.run, [1]

    def stopping(worker, block):
        if left[0] == 0:
            raise KeyboardInterrupt
        left[0] -= 1
        return original(worker, block)

    with monkeypatch.context() as patch:
        patch.setattr(PoseWorker, "run", stopping)
        with pytest.raises(KeyboardInterrupt):
            make_store(scene, "resumed.zarr", **SMALL)
    run.close_worker()
    resumed = make_store(scene, "resumed.zarr", **SMALL)
    whole = formats.open_store(store)
    for other in map(formats.open_store, (two, resumed)):
        assert other.names() == whole.names()
        for name in whole.names():
            assert other.read(name).tobytes() == whole.read(name).tobytes(), name


def test_a_store_without_poses_is_lit_as_ever(store):
    rgb, alpha = picture(store, env="sky")
    assert np.isfinite(rgb).all()
    assert alpha.max() == 1


def test_a_character_without_clips_stands_still(tmp_path):
    import json

    path = pose_scene(tmp_path)
    mesh = tmp_path / "bar.glb"
    data = mesh.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + size])
    del header["animations"]
    text = json.dumps(header).encode().ljust(size)
    mesh.write_bytes(data[:20] + text + data[20 + size :])
    opened = formats.open_store(make_store(path, **SMALL))
    assert "pose" not in opened.settings["effects"]
    plan = {row["effect"]: row["evidence"] for row in opened.attrs["plan"]}
    assert plan["pose"] == "no clip moves bar"


def test_bounces_beside_poses(scene):
    opened = formats.open_store(make_store(scene, "more.zarr", **{**SMALL, "bounces": 1}))
    assert opened.read("pose/0/visibility").shape[0] == 6
    rgb, _ = picture(opened.path, "more.exr", env="sky")
    assert np.isfinite(rgb).all()


def test_pixels_see_the_rest_pose_and_its_shadows(scene, tmp_path):
    """And nothing is traced for poses that they could not show. 64 samples a pixel of a reference leave 3 % noise."""
    store = make_store(scene, "pixels.zarr", **SMALL, receivers="pixels:main")
    opened = formats.open_store(store)
    assert "poses" not in opened.attrs
    plan = {row["effect"]: row["evidence"] for row in opened.attrs["plan"]}
    assert plan["pose"] == "pixels see the rest pose; poses need --receivers vertices"
    rgb, _ = picture(store, "pixels.exr", env="sky")
    truth = picture_of(render(scene, tmp_path / "truth.exr", spp=64))
    assert np.linalg.norm(rgb - truth) < 0.06 * np.linalg.norm(truth)
    with pytest.raises(InputError, match=r"--pose: .*pixels.zarr .*precompute --receivers vertices"):
        relight(RelightConfig(store=store, output=str(tmp_path / "a.exr"), quiet=True, poses=("bar=bend@1",)))
    with pytest.raises(StoreError, match=r"no poses to learn from.*--receivers vertices"):
        fit_pose(FitConfig(store=store, output=tmp_path / "pose.zarr", quiet=True))
    with pytest.raises(InputError, match=r"--receivers pixels:main: .*pose of bar; expected vertices"):
        make_store(scene, "never.zarr", **SMALL, receivers="pixels:main", effects="direct,shadows,pose")


def test_the_error_of_the_rays_is_measured(scene, store):
    def error(path):
        return inspect(path, verify=False)["cost"]["pose"]["relative_error"]

    few = make_store(scene, "rough.zarr", **{**SMALL, "pose_directions": 32})
    # 1 / n^(3/4) on smooth outlines: 4.8 for 8 times the rays. 32 checks of two blocks vary.
    assert 0 < 2 * error(store) < error(few) < 0.2

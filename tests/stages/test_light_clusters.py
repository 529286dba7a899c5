"""Clustered environment lights: the clusters, pictures from them, edits of the sky, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.images import read_environment, write_image
from relightcli.core.lights import quadtree
from relightcli.core.measure.errors import relative_rmse
from relightcli.core.sphere import cube
from relightcli.errors import InputError, StoreError
from relightcli.scene.model import Camera, Material
from relightcli.stages import clustered as clustered_stage
from relightcli.stages import light_cluster_job
from relightcli.stages.clustered import ClusteredStore, Runs
from relightcli.stages.light_clusters import Config, cluster_lights
from relightcli.stages.lighting import LightingStore
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import Part, lambert, sphere
from tests.stages.scene_files import make_store, picture, read_layers, write_scene
from tests.stages.test_precompute import array_bytes

CAMERA = Camera("main", (0.4, 1.6, 2.4), (0, 0.3, 0), fov=40, size=(48, 36))
GOLD = Material("m", "cook-torrance", (0.1, 0.08, 0.05), (0.8, 0.6, 0.4), f0=0.8, roughness=0.3)


def grid(cells, half, height=0.0, **kwargs):
    """A square of cells x cells cells that looks up."""
    x = np.linspace(-half, half, cells + 1)
    corners = np.array([[a, height, b] for a in x for b in x])
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = i * (cells + 1) + j
    triangles = np.concatenate([np.stack([a, a + 1, a + cells + 2], 1), np.stack([a, a + cells + 2, a + cells + 1], 1)])
    return Part(corners, triangles, np.tile([0.0, 1.0, 0.0], (len(corners), 1)), **kwargs)


def clusters(store, name="clusters.zarr", **settings):
    output = store.parent / name
    cluster_lights(Config(store=store, output=output, quiet=True, **{"resolution": 64, **settings}))
    return output


def irradiance(store, sky, rotate=0.0):
    """Of the receivers, (N, 3), from a transfer store or from clusters."""
    lighting = (ClusteredStore if "light_clusters" in formats.open_store(store).kind else LightingStore)(store, 2)
    (direct,) = lighting.exit_radiance(sky, rotate, lighting.scene.materials, None, bounces=0)
    return direct.diffuse


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {
        "ground": grid(24, 1.5, material=lambert((0.6, 0.5, 0.4))),
        "ball": sphere(0.4, (-0.5, 0.42, 0), rings=16, material=lambert((0.2, 0.5, 0.7))),
        "plate": grid(2, 0.4, 0.8, material=lambert(0.3)),
    }
    parts["plate"].two_sided = True
    return write_scene(tmp_path_factory.mktemp("scene"), parts, [CAMERA], {"smooth": smooth_map()}, adjustable=True)


@pytest.fixture(scope="module")
def transfer(scene):
    return make_store(scene, light_resolution=32, refine=2, subdivide=False)


@pytest.fixture(scope="module")
def clustered(transfer):
    return clusters(transfer)


def cells_of(store):
    return formats.open_store(store).read("light_clusters/cell")


def test_leaves_tile_the_cube_and_pass_the_test(clustered):
    store = formats.open_store(clustered)
    cells = cells_of(clustered)
    assert quadtree.solid_angles(cells, 64).sum() == pytest.approx(4 * math.pi, rel=1e-12)
    quadtree.build_tree([tuple(c) for c in cells.tolist()], 64)
    several = (cells[:, 2] - cells[:, 1]) * (cells[:, 4] - cells[:, 3]) > 1
    error = store.read("light_clusters/error")
    assert error[several].max() < store.settings["epsilon"]
    assert 6 < len(cells) < 6 * 64 * 64 / 4
    # Nothing is lit from below the ground, the underside of ball and plate apart.
    assert store.read("light_clusters/paper_error")[several].max() > 0


def test_lights_one_by_one_are_the_visibility_of_the_store(transfer):
    # epsilon 0 and the store's own resolution: every light is a cluster, and its fractions are bits.
    store = clusters(transfer, "all.zarr", resolution=32, epsilon=0.0)
    assert len(cells_of(store)) == 6 * 32 * 32
    fraction = formats.open_store(store).read("light_clusters/fraction")
    assert set(np.unique(fraction)) == {0, 255}
    bits = formats.open_store(transfer).read("visibility/bits")
    seen = np.unpackbits(bits.reshape(len(bits), -1), axis=1, bitorder="little")
    order = (cells_of(store) @ [32 * 32, 32, 0, 1, 0]).astype(int)
    np.testing.assert_array_equal(fraction.T[:, np.argsort(order)] == 255, seen == 1)
    sky = smooth_map()
    np.testing.assert_allclose(irradiance(store, sky), irradiance(transfer, sky), rtol=2e-2, atol=2e-3)


@pytest.mark.parametrize("rotate", [0.0, 137.0])
def test_pictures_as_from_the_transfer_store(transfer, clustered, rotate):
    rng = np.random.default_rng(0)
    for sky in (smooth_map(), rng.random((32, 64, 3)).astype(np.float32), np.ones((1, 1, 3), np.float32)):
        exact, ours = irradiance(transfer, sky, rotate), irradiance(clustered, sky, rotate)
        assert relative_rmse(ours, exact) < 0.01
        np.testing.assert_allclose(ours.mean(0), exact.mean(0), rtol=3e-3)


def test_white_furnace(tmp_path):
    scene = write_scene(
        tmp_path, {"ball": sphere(rings=16, material=lambert(1.0))}, [CAMERA], {"sky": np.ones((4, 8, 3))}
    )
    store = clusters(make_store(scene, light_resolution=16, refine=2), resolution=100)
    radiance = irradiance(store, np.ones((3, 5, 3), np.float32))
    assert np.sqrt(((radiance - 1) ** 2).mean()) < 6e-3
    np.testing.assert_allclose(radiance, 1.0, atol=0.05)  # where a cluster lies about the horizon


def test_count_hardly_depends_on_the_resolution(transfer):
    counts = [len(cells_of(clusters(transfer, f"{r}.zarr", resolution=r, epsilon=0.1))) for r in (128, 512, 4096)]
    assert counts[1] < 1.2 * counts[0]
    assert counts[2] < 1.03 * counts[1]


@pytest.mark.slow
def test_smaller_epsilon_gives_more_clusters_and_less_error(transfer):
    sky = np.zeros((64, 128, 3), np.float32)
    sky[12:16, 20:26] = 50  # several degrees wide, so that no point of it is traced apart
    exact = irradiance(clusters(transfer, "each.zarr", resolution=32, epsilon=0.0), sky)
    found = []
    for epsilon in (0.4, 0.2, 0.1):
        store = clusters(transfer, f"e{epsilon}.zarr", resolution=32, epsilon=epsilon)
        found.append((len(cells_of(store)), relative_rmse(irradiance(store, sky), exact)))
    assert found[0][0] < found[1][0] < found[2][0]
    assert found[0][1] > found[1][1] > found[2][1]
    assert found[2][1] < 0.05


@pytest.mark.slow
def test_mesh_cut_finer_keeps_the_clusters_by_rms_only(tmp_path):
    counts = {}
    for cells in (16, 32):
        parts = {"ground": grid(cells, 1.0, material=lambert(0.5)), "plate": grid(1, 0.4, 0.5, material=lambert(0.5))}
        scene = write_scene(tmp_path / str(cells), parts, [CAMERA], {"sky": smooth_map()})
        store = make_store(scene, light_resolution=32, refine=2, subdivide=False)
        for criterion in ("rms", "paper"):
            more = {"epsilon": 1e-3} if criterion == "paper" else {}
            counts[criterion, cells] = len(cells_of(clusters(store, f"{criterion}.zarr", criterion=criterion, **more)))
    assert counts["rms", 32] == pytest.approx(counts["rms", 16], rel=0.25)
    assert counts["paper", 32] < 0.6 * counts["paper", 16]


def test_thin_occluder_between_the_nine_samples(tmp_path, monkeypatch):
    # A rod over a point of the ground: nine samples of a face pass by it on both sides, the store's texels do not.
    rod = Part(
        np.array([[0.2, 1.0, -0.0225], [0.6, 1.0, -0.0225], [0.6, 1.0, 0.0225], [0.2, 1.0, 0.0225]]),
        np.array([[0, 2, 1], [0, 3, 2]]),
        two_sided=True,
        material=lambert(0.5),
    )
    ground = grid(4, 0.01, material=lambert(0.5))
    scene = write_scene(tmp_path, {"ground": ground, "rod": rod}, [CAMERA], {"sky": smooth_map()})
    store = make_store(scene, light_resolution=64, refine=1, subdivide=False)
    # The ground has a sixtieth of the area.
    seen = clusters(store, resolution=256, epsilon=0.1 / 8)
    worker = light_cluster_job.ClusterWorker
    monkeypatch.setattr(worker, "known", worker.nine)
    missed = clusters(store, "nine.zarr", resolution=256, epsilon=0.1 / 8)
    sky = np.zeros((180, 360, 3), np.float32)
    row, column = 21, 89  # and their neighbours: some three degrees about the rod's middle
    sky[row - 1 : row + 2, column - 4 : column + 5] = 1.0
    lighting = LightingStore(store, 1)
    ground = (lighting.position[:, 1] == 0) & (lighting.normal[:, 1] > 0)
    x = lighting.position[ground]
    exact = np.zeros(len(x))
    for i in np.arange(row - 1, row + 2, 0.05) + 0.025:
        for j in np.arange(column - 4, column + 5, 0.05) + 0.025:
            lon, lat = math.pi * (1 - j / 180), math.pi * (0.5 - i / 180)
            d = np.array([math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)])
            at = x + d / d[1]
            free = (np.abs(at[:, 0] - 0.4) > 0.2) | (np.abs(at[:, 2]) > 0.0225)
            exact += free * d[1] * math.cos(lat) * math.radians(0.05) ** 2 * 0.5 / math.pi
    whole = 27 * math.radians(1) ** 2 * math.cos(lat) * d[1] * 0.5 / math.pi
    assert 0.2 < exact.mean() / whole < 0.6
    assert relative_rmse(irradiance(seen, sky)[ground, 0], exact) < 0.15
    assert relative_rmse(irradiance(missed, sky)[ground, 0], exact) > 0.4


def test_budget_of_clusters_is_spent_where_the_error_is(transfer):
    sky = smooth_map()
    exact = irradiance(transfer, sky)
    errors = []
    for lights in (6, 60, 400):
        store = clusters(transfer, f"b{lights}.zarr", lights=lights, epsilon=0.0)
        count = len(cells_of(store))
        assert lights - 3 < count <= lights
        errors.append(formats.open_store(store).blocks[-1]["error"])
        assert relative_rmse(irradiance(store, sky), exact) < 0.3
    assert errors[0] > errors[1] > errors[2]
    # Best first beats one level for all: 384 cells of 8 x 8.
    assert errors[2] < 0.95 * even_error(transfer)


def even_error(transfer):
    """The check's error with the faces cut evenly into 8 x 8 cells."""
    parts = list(quadtree.roots(64))
    for _ in range(3):
        parts = [part for cell in parts for part in quadtree.children(cell)]
    original = light_cluster_job.ClusterWorker.accepts
    try:
        light_cluster_job.ClusterWorker.accepts = lambda self, cell: quadtree.lights(cell) <= 64
        store = clusters(transfer, "even.zarr")
    finally:
        light_cluster_job.ClusterWorker.accepts = original
    assert len(cells_of(store)) == len(parts)
    return next(b["error"] for b in formats.open_store(store).blocks if b["id"] == "check")


def test_budget_of_seconds(transfer):
    store = clusters(transfer, "s.zarr", seconds=1e-6, epsilon=0.0)
    assert len(cells_of(store)) == 6
    assert len(cells_of(clusters(transfer, "t.zarr", seconds=60.0))) > 100


def test_light_of_one_pixel_casts_its_shadow_to_the_texel(tmp_path):
    parts = {"ground": grid(160, 1.0, material=lambert(1.0)), "plate": grid(1, 0.3, 1.0, material=lambert(0.5))}
    parts["plate"].two_sided = True
    scene = write_scene(tmp_path, parts, [CAMERA], {"sky": np.ones((1, 1, 3))})
    store = clusters(make_store(scene, light_resolution=32, refine=2, subdivide=False), resolution=1024, epsilon=0.2)
    lighting = ClusteredStore(store, 2)
    ground = (lighting.position[:, 1] == 0) & (lighting.normal[:, 1] > 0)
    x = lighting.position[ground]
    for row, column in ((90, 700), (61, 333)):
        sky = np.zeros((512, 1024, 3), np.float32)
        sky[row, column] = 1e6
        lon, lat = math.pi * (1 - (column + 0.5) / 512), math.pi * (0.5 - (row + 0.5) / 512)
        d = np.array([math.sin(lon) * math.cos(lat), math.sin(lat), math.cos(lon) * math.cos(lat)])
        (direct,) = lighting.exit_radiance(sky, 0.0, lighting.scene.materials, None)
        lit = direct.diffuse[ground, 0] > 0.5 * direct.diffuse[ground, 0].max()
        at = x[:, [0, 2]] + d[[0, 2]] / d[1]  # where the ray passes the plate's height
        inside = np.abs(at).max(axis=1) - 0.3  # negative: blocked
        texel = (2.0 / 1024) / d[1] ** 2  # how far a light one texel away moves the shadow, at most
        sure = np.abs(inside) > texel
        np.testing.assert_array_equal(lit[sure], inside[sure] > 0)
        assert 50 < (~lit).sum() < len(lit) / 2
        solid = (2 * math.pi / 1024) * (
            math.sin(math.pi * (0.5 - row / 512)) - math.sin(math.pi * (0.5 - (row + 1) / 512))
        )
        # Within half a pixel of the map, and its corners, parts of the light are seen.
        whole = lit & (np.abs(inside) > 1.5 * (math.pi / 1024) / d[1] ** 2)
        np.testing.assert_allclose(direct.diffuse[ground][whole], 1e6 * solid * d[1] / math.pi, rtol=1e-3)


def test_thousand_edits_end_where_a_full_relight_does(clustered):
    rng = np.random.default_rng(3)
    lighting, fresh = ClusteredStore(clustered, 1), ClusteredStore(clustered, 1)
    sky = np.full((32, 64, 3), 1e-3, np.float32)
    changed = []
    for _ in range(1000):
        sky = sky.copy()
        i, j = rng.integers(0, 30), rng.integers(0, 62)
        # Wide enough lamps of up to 1e6, most of them painted over again.
        sky[i : i + 3, j : j + 3] = 10.0 ** rng.uniform(-3, 6) if rng.random() < 0.3 else 1e-3
        lighting.sky.set_light(sky, 0.0)
        changed.append(lighting.changed)
    assert np.median(changed) < 0.25 * len(cells_of(clustered))
    sky = np.full_like(sky, 1e-3)
    lighting.sky.set_light(sky, 0.0)
    fresh.sky.set_light(sky, 0.0)
    a, b = lighting.sky.irradiance, fresh.sky.irradiance
    assert relative_rmse(a, b) < 1e-5
    assert a.max() < 1  # all lamps are gone


def window(clustered, brightness):
    """A dim sky with a window, two pixels wide, in a corner of the cluster that is wrong by most."""
    cells, error = cells_of(clustered), formats.open_store(clustered).read("light_clusters/error")
    wide = (cells[:, 2] - cells[:, 1] >= 8) & (cells[:, 4] - cells[:, 3] >= 8)
    face, r0, _, c0, _ = cells[np.where(wide, error, 0.0).argmax()].tolist()
    d = cube.face_directions(face, np.array(2.0 * (c0 + 1) / 64 - 1), np.array(2.0 * (r0 + 1) / 64 - 1))
    row = round((0.5 - math.asin(d[1]) / math.pi) * 128)
    column = round((0.5 - math.atan2(d[0], d[2]) / (2 * math.pi)) * 256)
    sky = np.full((128, 256, 3), 0.001, np.float32)
    sky[row - 1 : row + 1, column - 1 : column + 1] = brightness
    return sky


def test_window_in_a_part_of_a_cluster_lights_from_there(transfer, clustered, monkeypatch):
    """Half as wrong as from whole clusters, at least, where a cluster is lit in a corner."""
    sky = window(clustered, 20.0)
    exact = irradiance(transfer, sky)
    lighting = ClusteredStore(clustered, 1)
    (found,) = lighting.exit_radiance(sky, 0.0, lighting.scene.materials, None, bounces=0)
    assert len(lighting.sky.bright) > 0
    monkeypatch.setattr(clustered_stage, "bright_cells", lambda flux, error: np.zeros(0, np.int64))
    whole = irradiance(clustered, sky)
    assert relative_rmse(found.diffuse, exact) < 0.5 * relative_rmse(whole, exact)


def test_windows_come_and_go_without_a_trace(clustered, tmp_path):
    """What is cut depends on the light alone: edits, and a picture taken up again, end where a full relight does."""
    dim, lit, brighter = (window(clustered, v) for v in (0.01, 20.0, 35.0))
    lighting = ClusteredStore(clustered, 1)

    def shine(sky):
        (direct,) = lighting.exit_radiance(sky, 0.0, lighting.scene.materials, None, bounces=0)
        return direct.diffuse

    for sky in (dim, lit, brighter, lit, dim, lit):
        now = shine(sky)
        np.testing.assert_allclose(now, irradiance(clustered, sky), rtol=1e-6, atol=1e-9)
        assert bool(len(lighting.sky.bright)) == (sky is not dim)
    for k, sky in enumerate((lit, dim)):
        write_image(tmp_path / f"{k}.exr", sky)
    radiance(clustered, "lit.zarr", tmp_path / "0.exr")
    resumed, _ = radiance(clustered, "resumed.zarr", tmp_path / "1.exr", previous=clustered.parent / "lit.zarr")
    anew, _ = radiance(clustered, "anew.zarr", tmp_path / "1.exr")
    first, second = (formats.open_store(store).read("light/irradiance") for store in (resumed, anew))
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-12)


def test_lamp_that_a_sun_outshines_returns_to_the_map(clustered):
    """What is a point depends on all light: an edit can change it far from where the map was changed."""
    dim = np.full((256, 512, 3), 0.01, np.float32)
    dim[60, 100] = 300.0
    sun = dim.copy()
    sun[90, 400] = 1e5
    lighting, points = ClusteredStore(clustered, 1), []
    for sky in (dim, sun, dim, sun):
        fresh = ClusteredStore(clustered, 1)
        for store in (lighting, fresh):
            store.sky.set_light(sky, 20.0)
        np.testing.assert_allclose(lighting.sky.light.moment, fresh.sky.light.moment, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(lighting.sky.lit(), fresh.sky.lit(), rtol=1e-6, atol=1e-9)
        points.append({tuple(d) for d in lighting.sky.points.direction.tolist()})
    assert points[0]
    assert points[1]
    assert not points[0] & points[1]


def test_edit_changes_its_clusters_only(clustered):
    lighting = ClusteredStore(clustered, 1)
    sky = smooth_map()
    lighting.sky.set_light(sky, 30.0)
    assert lighting.changed == len(cells_of(clustered))
    lighting.sky.set_light(sky, 30.0)
    assert lighting.changed == 0
    edited = sky.copy()
    edited[5, 7] += 0.5
    lighting.sky.set_light(edited, 30.0)
    assert 0 < lighting.changed < 0.1 * len(cells_of(clustered))
    fresh = ClusteredStore(clustered, 1)
    fresh.sky.set_light(edited, 30.0)
    np.testing.assert_allclose(lighting.sky.irradiance, fresh.sky.irradiance, rtol=1e-10, atol=1e-12)


def radiance(store, name, env, **more):
    output = store.parent / name
    told = relight(RelightConfig(store=store, output=str(output), env=str(env), quiet=True, **more))
    return output, told


def test_from_a_previous_result(clustered, tmp_path):
    before, after = tmp_path / "before.exr", tmp_path / "after.exr"
    sky = smooth_map()
    write_image(before, sky)
    sky = read_environment(before).copy()
    sky[10:12, 20:22] += 1
    write_image(after, sky)
    previous, _ = radiance(clustered, "r0.zarr", before)
    ours, told = radiance(clustered, "r1.zarr", after, previous=previous)
    truth, whole = radiance(clustered, "r2.zarr", after)
    assert 0 < told["changed_clusters"] < 0.2 * whole["changed_clusters"]
    a, b = formats.open_store(ours), formats.open_store(truth)
    for name in ("light/moment", "light/flux"):
        np.testing.assert_array_equal(a.read(name), b.read(name))
    np.testing.assert_allclose(a.read("light/irradiance"), b.read("light/irradiance"), rtol=1e-12)
    rgb, _ = picture(clustered, "a.exr", env=str(after), previous=previous)
    again, _ = picture(clustered, "b.exr", env=str(after))
    np.testing.assert_allclose(rgb, again, rtol=1e-3)


def test_from_refuses_what_it_cannot_use(transfer, clustered, scene):
    with pytest.raises(StoreError, match="kind"):
        radiance(transfer, "x.zarr", "smooth", previous=clustered)
    with pytest.raises(StoreError, match="kind"):
        radiance(clustered, "x.zarr", "smooth", previous=transfer)
    other, _ = radiance(transfer, "other.zarr", "smooth")
    with pytest.raises(StoreError, match="was not made from"):
        radiance(clustered, "x.zarr", "smooth", previous=other)
    with pytest.raises(InputError, match="--from: has nothing to give to --reference"):
        radiance(clustered, "x.exr", "smooth", previous=other, reference=True)


def _stop_after(patch, after):
    """The block after so many is interrupted; with a budget, the judging of so many cells."""
    left = [after]

    def stopping(original):
        def call(self, what):
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            return original(self, what)

        return call

    worker = light_cluster_job.ClusterWorker
    for name in ("run", "worst"):
        patch.setattr(worker, name, stopping(getattr(worker, name)))


@pytest.mark.parametrize("budget", [{}, {"lights": 100}], ids=["epsilon", "budget"])
def test_interrupted_runs_give_the_same_bytes(transfer, tmp_path, monkeypatch, budget):
    whole = tmp_path / "whole.zarr"
    make = {"store": transfer, "resolution": 64, "quiet": True, **budget}
    cluster_lights(Config(output=whole, workers=2, **make))
    parts = tmp_path / "parts.zarr"
    interruptions = 0
    for after in (0, 1, 40):
        with monkeypatch.context() as patch:
            _stop_after(patch, after)
            try:
                cluster_lights(Config(output=parts, **make))
            except KeyboardInterrupt:
                interruptions += 1
    cluster_lights(Config(output=parts, **make))
    assert interruptions >= 1
    assert array_bytes(whole) == array_bytes(parts)


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    parts = {
        "ground": grid(16, 1.5, material=lambert((0.6, 0.5, 0.4))),
        "ball": sphere(0.4, (-0.4, 0.42, 0), rings=24, material=GOLD),
        "plate": grid(1, 0.3, 1.0, material=lambert(0.3)),
    }
    other = replace(CAMERA, name="other", eye=(-1.0, 1.6, 2.4))
    scene = write_scene(
        tmp_path_factory.mktemp("glossy"), parts, [CAMERA, other], {"smooth": smooth_map()}, adjustable=True
    )
    return make_store(scene, light_resolution=64, subdivide=False)


@pytest.mark.slow
def test_specular_lobes_of_a_fixed_view(glossy):
    store = clusters(glossy, camera="main")
    sky = smooth_map()
    sun = sky.copy()
    sun[8, 40] += 3000
    write_image(glossy.parent / "sun.exr", sun)
    for env, bound in (("smooth", 0.03), (str(glossy.parent / "sun.exr"), 0.08)):
        for settings in ((), ("ball.specular=0.2,0.5,0.9", "ball.diffuse=0.3,0.1,0.1")):
            ours, _ = picture(store, "a.exr", env=env, settings=settings)
            exact, _ = picture(glossy, "b.exr", env=env, settings=settings)
            assert relative_rmse(ours, exact) < bound, (env, settings)
    with pytest.raises(InputError, match="for camera 'main' only"):
        picture(store, "c.exr", camera="other")
    with pytest.raises(InputError, match="ball: another specular lobe than the clusters were made for"):
        picture(store, "c.exr", settings=("ball.roughness=0.5",))
    # Diffuse light and lobes have cells of their own, runs of clusters.
    opened, tree = formats.open_store(store), ClusteredStore(store, 1).sky.tree
    solid = opened.read("light_clusters/solid_angle")
    for part, values in (("diffuse_cell", "fraction"), ("lobe_cell", "lobe")):
        own = opened.read(f"light_clusters/{part}")
        assert len(own) == opened.layouts[f"light_clusters/{values}"].shape[0] <= len(tree.cell)
        np.testing.assert_allclose(Runs(tree, own).sum(solid), quadtree.solid_angles(own, 64), rtol=1e-12)


def test_without_a_fixed_view_every_view_and_lobe_will_do(glossy):
    store = clusters(glossy, "any.zarr")
    with_lobes, matte = formats.open_store(store), formats.open_store(clusters(glossy, "fixed.zarr", camera="main"))
    assert "visibility/bits" in with_lobes
    assert "visibility/bits" not in matte
    for k, camera in enumerate(("main", "other")):
        for settings in ((), ("ball.roughness=0.5", "ball.specular=0.2,0.5,0.9")):
            given = {"env": "smooth", "camera": camera, "settings": settings, "layers": True}
            picture(store, f"a{k}.exr", **given)
            picture(glossy, f"b{k}.exr", **given)
            ours, exact = (read_layers(store.parent / f"{name}{k}.exr") for name in "ab")
            np.testing.assert_allclose(ours["specular"], exact["specular"], rtol=1e-5, atol=1e-6)
            assert relative_rmse(ours["direct"], exact["direct"]) < 0.03


@pytest.mark.slow
def test_specular_edits_are_incremental_too(glossy):
    store = clusters(glossy, "inc.zarr", resolution=64, camera="main")
    lighting, fresh = ClusteredStore(store, 1), ClusteredStore(store, 1)
    view = formats.open_store(store).read("light_clusters/view")
    sky = smooth_map()
    lighting.exit_radiance(sky, 0.0, lighting.scene.materials, view)
    edited = sky.copy()
    edited[6:9, 20:23] += 2
    (a,) = lighting.exit_radiance(edited, 0.0, lighting.scene.materials, view)
    (b,) = fresh.exit_radiance(edited, 0.0, fresh.scene.materials, view)
    assert lighting.changed < fresh.changed
    assert b.specular.max() > 0
    np.testing.assert_allclose(a.specular, b.specular, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_pixel_receivers(glossy):
    scene = glossy.parent / "scene.toml"
    transfer = make_store(scene, "pixels.zarr", receivers="pixels:main", light_resolution=32, refine=2)
    store = clusters(transfer, "pc.zarr", resolution=64)
    ours, alpha = picture(store, "a.exr", env="smooth")
    exact, truth = picture(transfer, "b.exr", env="smooth")
    np.testing.assert_array_equal(alpha, truth)
    assert relative_rmse(ours, exact) < 0.04
    with pytest.raises(InputError, match="pixels of camera 'main'"):
        clusters(transfer, "x.zarr", camera="other")


def test_lamps_and_translucent_leaves(tmp_path):
    leaf = grid(8, 0.5, 0.6, material=Material("m", "translucent", (0.3, 0.5, 0.2), transmittance=(0.4, 0.4, 0.1)))
    leaf.two_sided = True
    lamp = '[lights.lamp]\nshape = "sphere"\ncenter = [0.8, 1.2, 0.3]\nradius = 0.1\nradiance = [30, 20, 10]\n'
    scene = write_scene(tmp_path, {"ground": grid(12, 1.0), "leaf": leaf}, [CAMERA], {"sky": smooth_map()}, more=lamp)
    transfer = make_store(scene, light_resolution=32, refine=2, subdivide=False)
    store = clusters(transfer)
    assert relative_rmse(picture(store, "a.exr")[0], picture(transfer, "b.exr")[0]) < 0.01


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": 0}, "--light-resolution: expected 1 to 4096; found 0"),
        ({"resolution": 5000}, "--light-resolution: expected 1 to 4096; found 5000"),
        ({"epsilon": -1.0}, "--epsilon: expected 0 or more; found -1"),
        ({"epsilon": float("nan")}, "--epsilon: expected 0 or more; found nan"),
        ({"lights": 5}, "--lights: expected 6 or more"),
        ({"seconds": 0.0}, "--seconds: expected more than 0"),
        ({"camera": "side"}, "--camera side: not in the scene"),
    ],
    ids=str,
)
def test_bad_settings(transfer, settings, message):
    with pytest.raises(InputError, match=message):
        clusters(transfer, "bad.zarr", **settings)
    assert not (transfer.parent / "bad.zarr").exists()


def test_clustered_lights_can_be_path_traced(transfer, clustered):
    a, b = (picture(store, "traced.exr", reference=True, spp=4)[0] for store in (transfer, clustered))
    np.testing.assert_array_equal(a, b)


def test_other_stores_and_uses_are_refused(transfer, clustered):
    with pytest.raises(StoreError, match="expected a store of kind transfer, found light_clusters"):
        clusters(clustered, "twice.zarr")
    with pytest.raises(InputError, match="--basis: the store holds clustered lights"):
        picture(clustered, "x.exr", basis="visibility")
    with pytest.raises(StoreError, match="holds direct light only"):
        picture(clustered, "x.exr", bounces=1)

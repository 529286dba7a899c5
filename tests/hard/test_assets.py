"""Hard cases of transfer tensors: extreme materials, grazing light and view, regions of nothing, too much rank."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.transport.transfer import DIFFUSE
from relightcli.scene.model import Camera, Material
from relightcli.stages import cluster, factorize
from relightcli.stages.lighting import LightingStore
from relightcli.stages.transfer_setup import TransferSetup, coarse_cells
from tests.core.transport.scenes import Part, lambert, sphere
from tests.core.transport.test_buried import grid
from tests.stages.scene_files import make_store, write_scene
from tests.stages.test_asset import ground, layers_of

GOLD = Material("m", "cook-torrance", (0.2, 0.15, 0.1), (0.7, 0.6, 0.4), f0=0.8, roughness=0.3)
LACQUER = Material("m", "blinn-phong", (0.3, 0.1, 0.1), (0.3, 0.3, 0.3), shininess=50.0)
CAMERAS = [
    Camera("main", (0.4, 1.3, 2.6), (0, 0.4, 0), fov=38, size=(48, 36)),
    Camera("grazing", (0, 0.02, 2.4), (0, 0.02, 0), fov=30, size=(48, 36)),
]
PARTS = ("direct", "specular", "one_bounce", "two_bounce")
WHITE = ("ground.diffuse=1,1,1", "gold.diffuse=0,0,0", "gold.specular=1,1,1", "lacquer.diffuse=0.5,0.5,0.5")


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """A transfer store and an asset of more rank than the data has. `chip` is one triangle; `hidden` is in a shell."""
    inside = sphere(0.05, (-0.5, 0.32, 0), rings=4, material=lambert(0.9))
    chip = Part(
        np.array([[0.0, 0.05, 0.9], [0.3, 0.05, 0.9], [0.0, 0.3, 0.8]]), np.array([[0, 1, 2]]), None, material=GOLD
    )
    parts = {
        "ground": ground(10, lambert((0.6, 0.5, 0.4))),
        "shell": sphere(0.3, (-0.5, 0.32, 0), rings=10, material=lambert(0.5)),
        "hidden": inside,
        "gold": sphere(0.3, (0.45, 0.31, 0.1), rings=10, material=GOLD),
        "lacquer": sphere(0.2, (0.1, 0.21, 0.7), rings=8, material=LACQUER),
        "chip": chip,
    }
    horizon = np.zeros((64, 128, 3))
    horizon[30:32] = 5.0  # up to 6 degrees above it
    maps = {"even": np.ones((4, 8, 3)), "horizon": horizon}
    folder = tmp_path_factory.mktemp("hard")
    scene = write_scene(folder, parts, CAMERAS, maps, adjustable=True)
    options = {"light_resolution": 32, "bounce_resolution": 8, "subdivide": False, "workers": 2}
    transfer = make_store(scene, bounces=2, **options)
    clusters, asset = folder / "clusters.zarr", folder / "asset.zarr"
    cluster.cluster(cluster.Config(transfer, clusters, 8, functions=2, workers=2))
    said = factorize.factorize(factorize.Config(clusters, asset, 1024, 1024, workers=2))
    return transfer, asset, said


def test_more_rank_than_the_data_has_leaves_rounding_alone(stores):
    for error in stores[2]["errors"].values():
        assert error["compression"] < 1e-3
        assert error["total"] < 0.02  # 8 bits a value


@pytest.mark.parametrize("camera", ["main", "grazing"])
@pytest.mark.parametrize("env", ["even", "horizon"])
@pytest.mark.parametrize(
    "edit",
    [
        ("gold.roughness=0.005", "gold.f0=1", "lacquer.shininess=1000000"),
        ("gold.roughness=0.005", "gold.f0=0", "lacquer.shininess=0"),
        ("gold.roughness=1", "gold.f0=1", "lacquer.shininess=1"),
        ("gold.roughness=1", "gold.f0=0", "lacquer.shininess=1000000"),
        WHITE,
    ],
    ids=["sharp", "sharp and dark", "rough", "rough and dark", "white"],
)
def test_extremes_are_bounded_and_near_the_transfer_store(stores, edit, env, camera):
    transfer, asset, _ = stores
    a = layers_of(transfer, "a.exr", env=env, camera=camera, settings=edit)
    b = layers_of(asset, "b.exr", env=env, camera=camera, settings=edit)
    for name in PARTS:
        assert np.isfinite(b[name]).all()
        assert b[name].min() >= 0.0
        # No more than a white world would send: the brightest of the sky.
        assert b[name].max() <= (1.05 if env == "even" else 5.0), name
    if env == "horizon":
        # 96 Haar coefficients are spent on light from above: at grazing light direct tensors are too bright.
        b = layers_of(asset, "b.exr", env=env, camera=camera, settings=edit, basis="visibility")
    assert b[""].mean() == pytest.approx(a[""].mean(), rel=0.1)


def test_what_no_light_reaches_neither_gets_nor_gives(stores):
    _, asset, _ = stores
    lighting = LightingStore(asset, 1)
    hidden = lighting.geometry.material[lighting.object] == list(lighting.scene.materials).index("hidden")
    assert hidden.any()
    output = asset.parent / "vertices.zarr"
    from relightcli.stages.relight import Config, relight

    relight(Config(store=asset, output=str(output), env="even", camera="main", quiet=True))
    radiance = formats.open_store(output).read("radiance")[0]
    assert radiance[~hidden].mean() > 0.1
    assert radiance[hidden].max() < 0.02
    other = layers_of(asset, "c.exr", env="even", settings=("hidden.diffuse=0,0,0",))
    np.testing.assert_allclose(other[""], layers_of(asset, "d.exr", env="even")[""], atol=1e-4)


def test_a_region_of_one_triangle_changes_alone(stores):
    _, asset, _ = stores
    as_it_is = layers_of(asset, "e.exr", env="even")
    black = layers_of(asset, "f.exr", env="even", settings=("chip.diffuse=0,0,0", "chip.specular=0,0,0"))
    lost = (as_it_is[""] - black[""]).mean(2)
    assert lost.max() > 0.05
    assert (abs(lost) < 0.02).mean() > 0.9


def test_white_closed_box_is_bounded(tmp_path):
    # Albedo 1 all around and a lamp: every interreflection keeps the light and adds none.
    corners, triangles = [], []
    for origin, u, v in (
        ((-1, -1, -1), (2, 0, 0), (0, 0, 2)),
        ((-1, 1, -1), (0, 0, 2), (2, 0, 0)),
        ((-1, -1, -1), (0, 0, 2), (0, 2, 0)),
        ((1, -1, -1), (0, 2, 0), (0, 0, 2)),
        ((-1, -1, -1), (0, 2, 0), (2, 0, 0)),
        ((-1, -1, 1), (2, 0, 0), (0, 2, 0)),
    ):
        points, faces = grid(origin, u, v, 6)
        facing = np.cross(points[faces[0, 1]] - points[faces[0, 0]], points[faces[0, 2]] - points[faces[0, 0]])
        inwards = facing @ (0.0 - points.mean(0)) > 0
        triangles.append((faces if inwards else faces[:, ::-1]) + sum(len(c) for c in corners))
        corners.append(points)
    room = Part(np.concatenate(corners), np.concatenate(triangles), None, material=lambert(1.0))
    lamp = "[lights.lamp]\nshape = 'sphere'\ncenter = [0, 0.2, 0]\nradius = 0.1\nradiance = [10, 10, 10]\n"
    camera = Camera("main", (0, 0, 0.8), (0, 0, -1), fov=70, size=(16, 16))
    scene = write_scene(tmp_path, {"room": room}, [camera], {"sky": np.zeros((4, 8, 3))}, adjustable=True, more=lamp)
    store = make_store(scene, bounces=2, light_resolution=32, bounce_resolution=8, subdivide=False)
    cluster.cluster(cluster.Config(store, tmp_path / "c.zarr", 2))
    factorize.factorize(factorize.Config(tmp_path / "c.zarr", tmp_path / "a.zarr"))
    layers = layers_of(tmp_path / "a.zarr", "a.exr", env="sky")
    means = [layers[name].mean() for name in ("direct", "one_bounce", "two_bounce")]
    assert means[0] > 0
    # Coarse walls and cells: within 15 % a bounce.
    assert means[0] * 0.8 < means[1] < means[0] * 1.15
    assert means[1] * 0.85 < means[2] < means[1] * 1.15


def test_transport_between_two_regions_is_reciprocal(tmp_path):
    """Even light seen by region a, reflected to b, weighted by what b sees of the sky, is the same from b to a."""
    parts = {
        "ground": ground(32, lambert(0.5)),
        "ball": sphere(0.4, (0.2, 0.42, 0.3), rings=24, material=lambert(0.5)),
    }
    points, faces = grid((-1.2, 0.0, -0.9), (2.4, 0, 0), (0, 1.2, 0), 24)
    parts["wall"] = Part(points, faces, np.tile([0.0, 0.0, 1.0], (len(points), 1)), material=lambert(0.5))
    scene = write_scene(tmp_path, parts, CAMERAS[:1], {"even": np.ones((4, 8, 3))}, adjustable=True)
    store = make_store(scene, bounces=1, light_resolution=64, bounce_resolution=16, subdivide=False)
    lighting = LightingStore(store, 2)
    setup = TransferSetup(lighting, 4, 2)
    rows = np.arange(len(lighting))
    one = setup.gather_rows(rows, setup.sources(coarse_cells()), 0)[:, :, 0].sum(2)  # per channel, under even light
    materials = lighting.scene.materials
    direct = lighting.exit_radiance(np.ones((4, 8, 3), np.float32), 0.0, materials, None, bounces=0)[0]
    corner = lighting.geometry.positions[lighting.geometry.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 6.0
    share = np.bincount(lighting.geometry.faces.reshape(-1), np.repeat(area, 3), len(lighting.geometry.positions))
    weight = share[lighting.vertex] * direct.diffuse[:, 0] / 0.5
    material = lighting.geometry.material[lighting.object]
    channel = {int(m): q for q, m in enumerate(setup.channels.material) if setup.channels.part[q] == DIFFUSE}
    found = np.array([[weight[material == b] @ one[material == b, channel[a]] for b in range(3)] for a in range(3)])
    assert found.min() >= 0.0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert found[a, b] > 1e-3
        # Measured 1.7 % at worst; 5 % with cells twice as large, 0.8 % with twice the resolution of light and bounces.
        assert found[a, b] == pytest.approx(found[b, a], rel=0.03)

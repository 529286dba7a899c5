"""The invariants again, on every way from a scene to a picture: other bases, clusters, tensors, fields and poses.

What `test_invariants` asks of the transfer store as it comes is asked here of all that is made from it or beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from relightcli.stages import cluster, factorize, fit_pose, light_clusters
from tests.core.transport.scenes import lambert, sphere, square
from tests.hard.test_invariants import (
    CAMERA,
    GOLD,
    apart,
    layers,
    quarter,
    shiny,
    shuffled_faces,
    shuffled_vertices,
    sky,
)
from tests.hard.test_invariants import turned as turned_part
from tests.stages.pose_files import SCENE, pose_scene
from tests.stages.scene_files import make_store, write_scene

PATHS = ("haar", "sh", "clusters", "asset", "light clusters", "moved", "posed")
SETTINGS = {"light_resolution": 16, "subdivide": False}
BOUNCE = {"bounces": 1, "bounce_resolution": 8}
PLACE = np.array([0.3, 0.75, 0.2])  # where a ball is moved to
POSE = "bar=bend@1.3"


@dataclass(frozen=True)
class Change:
    """What is done to a scene that must not change its picture: size, quarter turns about +Y, order in the file."""

    size: float = 1.0
    quarters: int = 0
    shuffled: bool = False

    def points(self, points):
        return np.asarray(points) @ quarter(self.quarters).T * self.size

    def part(self, part):
        part = turned_part(part, quarter(self.quarters)) if self.quarters else part
        part = replace(part, corners=part.corners * self.size)
        return shuffled_faces(shuffled_vertices(part)) if self.shuffled else part

    def camera(self, camera):
        return replace(camera, eye=tuple(self.points(camera.eye)), target=tuple(self.points(camera.target)))


class Places:
    """Stores by path and change, each made once."""

    def __init__(self, folder):
        self.folder, self.stores, self.pictures = folder, {}, {}

    def store(self, path, change=Change()):
        if (path, change) not in self.stores:
            self.stores[path, change] = getattr(self, path.replace(" ", "_"))(change)
        return self.stores[path, change]

    def picture(self, path, change=Change(), pixels=None, **settings):
        """All layers under a sky, the first if no other."""
        more = {"env_rotate": 90.0 * change.quarters, **settings}
        if path == "moved":
            more["moves"] = (f"ball={','.join(repr(float(x)) for x in change.points(PLACE))}",)
        if path == "posed":
            more["poses"] = (POSE,)
        return layers(self.store(path, change), sky(1) if pixels is None else pixels, **more)

    def plain(self, path, change=Change()):
        """The same, kept: what others are compared with."""
        if (path, change) not in self.pictures:
            self.pictures[path, change] = self.picture(path, change)
        return self.pictures[path, change]

    def scene(self, name, change, parts):
        folder = self.folder / f"{name}-{len(self.stores)}"
        changed = {key: change.part(part) for key, part in parts.items()}
        return write_scene(folder, changed, [change.camera(CAMERA)], {"sky": sky(1)}, adjustable=True)

    def transfer(self, change):
        return make_store(self.scene("transfer", change, shiny(6)), **SETTINGS, **BOUNCE)

    def haar(self, change):
        return make_store(self.scene("haar", change, shiny(6)), basis="haar", **SETTINGS)

    def sh(self, change):
        return make_store(self.scene("sh", change, shiny(6)), basis="sh", **SETTINGS)

    def clusters(self, change):
        source = self.store("transfer", change)
        output = source.with_name("clusters.zarr")
        cluster.cluster(cluster.Config(source, output, 2, quiet=True))
        return output

    def asset(self, change):
        source = self.store("clusters", change)
        output = source.with_name("asset.zarr")
        factorize.factorize(factorize.Config(source, output, quiet=True))
        return output

    def light_clusters(self, change):
        source = self.store("transfer", change)
        output = source.with_name("lights.zarr")
        light_clusters.cluster_lights(light_clusters.Config(source, output, resolution=16, quiet=True))
        return output

    def moved(self, change):
        parts = {
            "floor": square(3.0, material=lambert(0.5)),
            "gold": sphere(0.25, (-0.6, 0.3, 0), rings=6, material=GOLD),
            "ball": sphere(0.4, (0, 0, 0), rings=8, material=lambert(0.7)),
        }
        path = self.scene("moved", change, parts)
        at = change.points((0.0, 0.6, 0.0)).tolist()
        mesh = "mesh = 'ball.obj'"
        path.write_text(path.read_text().replace(mesh, f"{mesh}\nmotion = 'rigid'\ntranslate = {at}"))
        fields = {"field_shells": 4, "field_resolution": 4, "field_proxies": 2}
        return make_store(path, **SETTINGS, **BOUNCE, **fields)

    def posed(self, change):
        turn, size = 90 * change.quarters, change.size
        text = SCENE.replace("translate = [0, 0.1, 0]", f"translate = [0, {0.1 * size}, 0]\nscale = {size}")
        text = text.replace('motion = "skinned"', f'motion = "skinned"\nrotate = [0, 1, 0, {turn}]')
        text = text.replace("[materials.grey]", "[materials.grey]\nadjustable = true")
        text = text.replace("[materials.red]", "[materials.red]\nadjustable = true")
        for key, value in (("eye", [0.5, 1.5, 5]), ("target", [0, 1, 0])):
            text = text.replace(f"{key} = {value}", f"{key} = {change.points(value).tolist()}")
        path = pose_scene(self.folder / f"posed-{len(self.stores)}", text)
        floor = square(6.0)
        lines = [f"v {' '.join(map(repr, p))}" for p in change.points(floor.corners).tolist()]
        (path.parent / "floor.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4"]) + "\n")
        source = make_store(path, bounces=0, pose_directions=64, pose_frames="spread:6", **SETTINGS)
        output = path.parent / "pose.zarr"
        fit_pose.fit_pose(fit_pose.Config(source, output, model="sh", quiet=True))
        return output


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return Places(tmp_path_factory.mktemp("paths"))


@pytest.mark.parametrize("path", PATHS)
def test_layers_add_up(places, within, path):
    """float32 sums of three or four layers: some roundings of 2^-24."""
    found = places.plain(path)
    assert found[""].max() > 0.1
    total = sum(rgb.astype(np.float64) for key, rgb in found.items() if key not in ("", "A"))
    within(f"{path}: beauty less its layers", apart(total, found[""]), 1e-6)


@pytest.mark.parametrize("path", PATHS)
def test_brightness(places, within, path):
    """Every step scales alike in float32, thresholds are shares of the whole: some roundings of sums."""
    one, other = places.plain(path)[""], places.picture(path, pixels=sky(1) * 1e6)[""]
    within(f"{path}: sky times 1e6", apart(other / 1e6, one), 5e-6)


@pytest.mark.parametrize("path", PATHS)
def test_two_skies(places, within, path):
    """Superposition, as in `test_invariants`: directions of texels' light and the choice of the brightest move."""
    a, b = sky(1), 3.0 * sky(5)
    both = places.picture(path, pixels=a + b)[""].astype(np.float64)
    within(f"{path}: two skies", apart(places.plain(path)[""] + places.picture(path, pixels=b)[""], both), 2e-3)


@pytest.mark.parametrize("path", PATHS)
def test_any_size(places, within, path):
    """A power of two leaves every mantissa as it is."""
    found = places.picture(path, Change(size=2.0**-20))
    within(f"{path}: 2^-20 times as large", apart(found[""], places.plain(path)[""]), 0.0)


@pytest.mark.parametrize("path", [p for p in PATHS if p != "posed"])
def test_any_order(places, within, path):
    found = places.picture(path, Change(shuffled=True))
    within(f"{path}: vertices and faces shuffled", apart(found[""], places.plain(path)[""]), 2e-3)


@pytest.mark.parametrize("path", PATHS)
def test_turned_with_its_sky(places, within, path):
    found, wanted = places.picture(path, Change(quarters=1))[""], places.plain(path)[""]
    difference = found.astype(np.float64) - wanted
    within(f"{path}: turned, rms", float(np.sqrt((difference**2).mean()) / wanted.max()), 5e-3)


MATTE = ("floor.diffuse=1,1,1", "gold.diffuse=1,1,1", "gold.specular=0,0,0")
WHITE = dict.fromkeys(PATHS, (*MATTE, "lacquer.diffuse=1,1,1", "lacquer.specular=0,0,0")) | {
    "moved": (*MATTE, "ball.diffuse=1,1,1"),
    "posed": ("grey.diffuse=1,1,1", "red.diffuse=1,1,1"),
}
EVEN = np.ones((4, 8, 3))


@pytest.mark.parametrize("path", PATHS)
def test_white_is_not_brighter_than_its_sky(places, within, path):
    """Furnace: what is white under a white sky gives back no more than it, and all of it where nothing is above: 1 %
    is the quadrature of a clamped cosine by 16 texels a side."""
    found = places.picture(path, pixels=EVEN, settings=WHITE[path])
    within(f"{path}: above 1", float(found[""].max() - 1.0), 0.01)
    within(f"{path}: brightest below 1", float(1.0 - found[""].max()), 0.01)


@pytest.mark.parametrize("path", PATHS)
def test_black_and_one_pixel(places, within, path):
    """Nothing gives nothing. One pixel says what many of the same say: 1e-5 is what taking a map to the cube keeps."""
    assert (places.picture(path, pixels=np.zeros((4, 8, 3)))[""] == 0).all()
    one, many = (places.picture(path, pixels=pixels)[""] for pixels in (np.ones((1, 1, 3)), EVEN))
    within(f"{path}: one pixel or many", apart(one, many), 1e-5)


@pytest.mark.parametrize("texel", [(0, 7), (3, 5)], ids=["pole", "sky"])
@pytest.mark.parametrize("path", PATHS)
def test_sun_beside_a_dark_sky(places, within, path, texel):
    """A texel of 1e6 beside 1e-3: apart they add up to both. Under the sun alone single pixels hold all light there is,
    so that sums of float32 lose 1e-6 of it, and lobes are treated alike, as in `test_two_skies`."""
    sun, dark = np.zeros((16, 32, 3)), np.full((16, 32, 3), 1e-3)
    sun[texel] = 1e6
    dark[texel] = 0.0
    alone = places.picture(path, pixels=sun)[""].astype(np.float64)
    total = alone + places.picture(path, pixels=dark)[""]
    within(f"{path}: sun and sky", apart(total, places.picture(path, pixels=sun + dark)[""]), 2e-3)
    # Albedos are below 1, and a mirror shows the sun itself at the most.
    within(f"{path}: brighter than the sun", float(alone.max()), 1e6)


SHARP = ("gold.roughness=1e-4", "gold.f0=1", "lacquer.shininess=1e6")
DULL = ("gold.roughness=10", "gold.f0=0", "lacquer.shininess=0")


@pytest.mark.parametrize("edit", [SHARP, DULL], ids=["sharp", "dull"])
@pytest.mark.parametrize("path", [p for p in PATHS if p != "posed"])
def test_materials_at_their_extremes(places, within, path, edit):
    """Under an even sky of 1 gold gives back 0.9 of it at most, lacquer 0.6 and what Blinn-Phong gains towards grazing
    views, below twice its specular colour: 0.9; one reflection of the floor's 0.4 is in what falls on them already.
    The 8 bits of an asset's values lose 1 % (its own `total` error)."""
    found = places.picture(path, pixels=EVEN, settings=[e for e in edit if path != "moved" or e.startswith("gold")])
    within(f"{path}: brightest", float(found[""].max()), 0.9 * 1.01 if path == "asset" else 0.9)

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relightcli.errors import StoreError
from relightcli.scene.build import build_geometry
from relightcli.scene.describe import scene_from_json, scene_to_json
from relightcli.scene.model import Camera, Material, ObjectSpec, Scene, SphereLight
from relightcli.scene.parse import load_scene
from tests.scene.test_parse import FULL, write


def through_json(scene, geometry=None):
    """As a store keeps it: with sorted keys."""
    return json.loads(json.dumps(scene_to_json(scene, geometry), allow_nan=False, sort_keys=True))


def same(a: Scene, b: Scene) -> bool:
    """Equality of scenes; arrays are not comparable by ==."""

    def plain(scene):
        objects = {
            n: (o.mesh, o.material, o.transform.tolist(), o.two_sided, o.motion) for n, o in scene.objects.items()
        }
        return dataclasses.replace(scene, objects=objects), list(scene.objects), list(scene.materials)

    return plain(a) == plain(b)


def test_a_scene_comes_back_without_its_files(scene_folder):
    scene = load_scene(write(scene_folder, FULL))
    description = through_json(scene)
    for path in scene_folder.iterdir():
        path.unlink()
    assert same(scene_from_json(description), scene)


def test_the_geometrys_counts_and_notes_are_kept(scene_folder):
    text = FULL.replace('diffuse_texture = "wood.png"\n', "")
    (scene_folder / "triangle.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 1 2\n")
    scene = load_scene(write(scene_folder, text))
    description = through_json(scene, build_geometry(scene))
    assert description["geometry"]["vertices"] == {"bunny": 3, "other": 3}
    assert description["geometry"]["faces"] == {"bunny": 1, "other": 1}
    assert len(description["geometry"]["notes"]) == 2
    assert same(scene_from_json(description), scene)


number = st.floats(-1e6, 1e6)
share = st.floats(0, 1)


@given(
    transform=st.lists(number, min_size=3, max_size=3),
    fov=st.floats(0.1, 179),
    colour=st.tuples(share, share, share),
    radius=st.floats(1e-300, 1e300),
)
def test_every_float_comes_back_exactly(transform, fov, colour, radius):
    matrix = np.eye(4)
    matrix[:3, 3] = transform
    scene = Scene(
        path=Path("/a/scene.toml"),
        objects={"o": ObjectSpec("o", Path("/a/o.ply"), "m", matrix)},
        materials={"m": Material("m", diffuse=colour)},
        lights={"l": SphereLight("l", (0.1, 0.2, 0.3), radius, colour)},
        cameras={"c": Camera("c", (0.1, 0.2, 0.3), (1 / 3, 0.0, 0.0), fov=fov)},
        tolerance=max(colour[0], 1e-9),
    )
    assert same(scene_from_json(through_json(scene)), scene)


def test_environments_keep_both_paths_and_are_found_again(scene_folder):
    scene = load_scene(write(scene_folder, FULL))
    description = through_json(scene)
    entry = description["environments"]["sky"]
    assert entry == {"map": str(scene_folder / "sky.exr"), "relative": "sky.exr"}
    other = scene_folder.parent / "other"
    other.mkdir()
    (other / "sky.exr").touch()
    assert scene_from_json(description, folder=other).environments["sky"] == scene_folder / "sky.exr"
    moved = scene_folder.parent / "moved"
    scene_folder.rename(moved)
    assert scene_from_json(description).environments["sky"] == scene_folder / "sky.exr"
    assert scene_from_json(description, folder=moved).environments["sky"] == moved / "sky.exr"


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: d.clear(),
        lambda d: d.pop("path"),
        lambda d: d.update(format=2),
        lambda d: d.update(extra=1),
        lambda d: d["materials"]["gold"].update(roughness=-1),
        lambda d: d["materials"].pop("gold"),
        lambda d: d["objects"]["bunny"].update(transform=[[0] * 4] * 4),
        lambda d: d["environments"]["sky"].pop("relative"),
        lambda d: d["cameras"]["main"].update(size=[0, 0]),
        lambda d: d.update(lights=[]),
    ],
)
def test_a_damaged_description_is_the_stores_fault(scene_folder, damage):
    description = through_json(load_scene(write(scene_folder, FULL)))
    damage(description)
    with pytest.raises(StoreError, match="scene description is damaged"):
        scene_from_json(description)


def test_a_description_of_another_kind():
    with pytest.raises(StoreError, match="expected an object"):
        scene_from_json([1, 2])


def test_the_files_order_survives_sorted_keys():
    scene = Scene(
        path=Path("/a/scene.toml"),
        objects={n: ObjectSpec(n, Path(f"/a/{n}.ply"), "z", np.eye(4)) for n in ("q", "b")},
        materials={n: Material(n) for n in ("z", "a", "m")},
        cameras={n: Camera(n, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)) for n in ("main", "close")},
    )
    again = scene_from_json(through_json(scene))
    assert list(again.objects) == ["q", "b"]
    assert list(again.materials) == ["z", "a", "m"]
    assert list(again.cameras) == ["main", "close"]


def test_an_order_that_does_not_fit_is_the_stores_fault():
    scene = Scene(path=Path("/a/scene.toml"), objects={}, materials={"z": Material("z"), "a": Material("a")})
    description = through_json(scene)
    description["order"]["materials"] = ["z", "z"]
    with pytest.raises(StoreError, match=r"order\.materials"):
        scene_from_json(description)

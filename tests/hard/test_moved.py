"""Things put where fields say least: into each other, around what receives, on the very shells, out of every reach."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.core.fields.field import GEOMETRIC_RANGE
from relightcli.scene.model import Camera
from relightcli.stages.relight import Config, relight
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import make_store, write_scene

CAMERA = Camera("main", (0, 2.5, 4.5), (0, 0.6, 0), fov=40, size=(16, 12))
RADIUS = 0.5
INNERMOST, OUTERMOST = (RADIUS * x for x in GEOMETRIC_RANGE)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A floor, a small ball that stands at (0, 1, 0), and two rigid balls that are alike."""
    parts = {
        "floor": square(3.0, material=lambert(0.5)),
        "standing": sphere(0.2, (0.0, 1.0, 0.0), rings=6, material=lambert(0.7)),
        "one": sphere(RADIUS, rings=8, material=lambert(0.7)),
        "two": sphere(RADIUS, rings=8, material=lambert(0.7)),
    }
    path = write_scene(tmp_path_factory.mktemp("moved"), parts, [CAMERA], {"even": np.ones((4, 8, 3))})
    text = path.read_text()
    for name, place in (("one", [-1.0, 0.6, 0.0]), ("two", [1.0, 0.6, 0.0])):
        text = text.replace(f"mesh = '{name}.obj'", f"mesh = '{name}.obj'\nmotion = 'rigid'\ntranslate = {place}")
    path.write_text(text)
    return make_store(
        path, light_resolution=16, bounce_resolution=8, subdivide=False, bounces=1,
        field_shells=4, field_resolution=4, field_proxies=2,
    )  # fmt: skip


def radiance(store, *moves):
    output = store.parent / "out.zarr"
    relight(Config(store=store, output=str(output), env="even", moves=moves, workers=1, quiet=True, overwrite=True))
    found = formats.open_store(output).read("radiance")[0]
    assert np.isfinite(found).all()
    assert found.min() >= 0.0
    return found.astype(np.float64)


PLACES = {
    "two things in one place": ("one=0,3,0", "two=0,3,0"),
    "in one place, turned": ("one=0,3,0", "two=0,3,0,30,40,50"),
    "nearly in one place": ("one=0,3,0", "two=1e-12,3,0"),
    "around what stands": ("one=0,1,0", "two=9,9,9"),
    "both around what stands": ("one=0,1,0", "two=0.1,1,0"),
    "half in the floor": ("one=0,0,0", "two=1,0,1"),
    "under the floor": ("one=0,-0.5,0", "two=1,-3,0"),
    "its innermost shell on what stands": (f"one=0,{1.2 + INNERMOST},0", "two=9,9,9"),
    "its outermost shell on what stands": (f"one=0,{1.2 + OUTERMOST},0", "two=9,9,9"),
    "touching": ("one=-0.5,3,0", "two=0.5,3,0"),
    "a thousand sizes away": ("one=500,0,0", "two=0,500,0"),
    "a billion sizes away": ("one=5e8,0,0", "two=0,5e8,0"),
    "in millionths": ("one=1e-6,0,0,0,0,1e-6,0,3,0,0,1e-6,0,0,0,0,1", "two=9,9,9"),
}


@pytest.mark.parametrize("place", PLACES)
def test_light_is_bounded_wherever_things_are_put(store, within, place):
    """Grey things under an even sky of 1 are darker than 0.7 of it plus one reflection, 0.7 + 0.7^2 * 0.5 at the very
    most, as what one thing takes from the sky it gives back at 0.7. Four bands overshoot by some percent."""
    found = radiance(store, *PLACES[place])
    within(f"{place}: brightest", float(found.max()), 0.7 + 0.7**2 * 0.5)


def test_what_is_far_away_is_not_there(store, within):
    """A ball 1e9 of its sizes away covers 1e-18 of the sky; 1000 away it covers 1e-6 / 4 of it, which fields, whose
    difference from empty space falls with the square, say too. float32 sums: 1e-6."""
    gone = radiance(store, "one=5e8,0,0", "two=0,5e8,0")
    near = radiance(store, "one=500,0,0", "two=0,500,0")
    within("a thousand sizes away or a billion", float(np.abs(near - gone).max()), 1e-5)


def test_two_things_in_one_place_are_at_worst_black(store, within):
    """Where two things are one, each hides the sky from the other's proxies, and which surface is seen is open: what
    both give back is between nothing and what one gives. The nearest point of what stands has 0.39 of its irradiance
    covered, so that 0.7 * 0.7 * 0.39 is missing at most, and 0.7 / 4 at the edge of the shadow, where V^2 of four
    bands is not V. It never becomes brighter, but for the bands' overshoot of some percent."""
    alone, both = radiance(store, "one=0,2,0", "two=0,5e8,0"), radiance(store, "one=0,2,0", "two=0,2,0")
    rows = slice(0, 4 + 7 * 12)  # floor and ball
    within("darker than beside one", float((alone[rows] - both[rows]).max()), 0.7 * 0.7 * 0.39 + 0.7 / 4)
    within("brighter than beside one", float((both[rows] - alone[rows]).max()), 0.02)


def test_order_of_names_does_not_matter(store, within):
    """Things that are alike change places."""
    a = radiance(store, "one=-0.7,0.8,0.2", "two=0.6,1.6,0.1")
    b = radiance(store, "two=-0.7,0.8,0.2", "one=0.6,1.6,0.1")
    rows = slice(0, 4)
    within("exchanged, light of the floor", float(np.abs(a[rows] - b[rows]).max()), 1e-5)

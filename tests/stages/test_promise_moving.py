"""precompute --tolerance where objects may be moved: fields that keep it, other places, and what is said of a miss."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.errors import InputError, NumericalError
from relightcli.scene.build import build_geometry
from relightcli.scene.moving import apply_moves, move_geometry
from relightcli.scene.parse import load_scene
from relightcli.stages.fields import FieldSettings
from relightcli.stages.measured_error import edit_of
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from relightcli.stages.promise_moving import CHECK, CHOSEN, RUNGS, TRIAL, free_moves, rungs
from tests.core.transport.scenes import lambert
from tests.stages.test_moving import errors, write

SMALL = {
    "subdivide": False,
    "light_resolution": 16,
    "bounces": 1,
    "field_shells": 4,
    "field_resolution": 4,
    "field_proxies": 2,
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write(tmp_path_factory.mktemp("moving-promise"))


def run(scene, output, **settings):
    return precompute(Config(scene, output, quiet=True, **{"workers": 1, **SMALL, **settings}))


def test_error_of_moved_objects_is_kept(scene):
    store = scene.parent / "kept.zarr"
    run(scene, store, tolerance=0.4)
    kept = formats.open_store(store)
    measured, tried = kept.attrs["measured_error"], kept.attrs["fields_tried"]
    assert measured["share"] <= measured["tolerance"] == kept.settings["tolerance"] == 0.4
    assert tried[-1]["share"] <= CHOSEN * 0.4
    assert kept.attrs["fields"]["settings"]["transfer_tolerance"] == tried[-1]["transfer_tolerance"]
    # What is promised: objects where neither the trial nor the check has put them, under a sky that neither knows.
    found = errors(store, ("ball=0.3,0.7,0.6", "block=-0.9,0.5,0.3"))
    assert found["together"] <= 0.4
    assert run(scene, store, tolerance=0.4)["status"] == "up to date"


def test_a_miss_is_told_and_what_was_tried_is_not_tried_again(scene):
    store = scene.parent / "miss.zarr"
    with pytest.raises(NumericalError, match=r"more than the tolerance of 1\.00%.*--field-order [56]"):
        run(scene, store, tolerance=0.01)
    assert not store.exists()
    done = run(scene, store, tolerance=0.01, allow_miss=True)
    assert done["status"] == "resumed"
    kept = formats.open_store(store)
    shares = [row["share"] for row in kept.attrs["fields_tried"]]
    assert 2 <= len(shares) <= len(RUNGS)
    assert all(share > CHOSEN * 0.01 for share in shares)
    # Of the fields that were tried, those of one rung are left, and the store is whole.
    used = {entry["field"] for entry in kept.attrs["fields"]["objects"].values()}
    assert {int(name.split("/")[1]) for name in kept.names() if name.startswith("fields/")} == used
    assert not kept.verify()


def test_what_is_asked_for_stays():
    assert [r.shells for r in rungs(FieldSettings())] == [8, 16, 16]
    assert {(r.shells, r.order) for r in rungs(FieldSettings(shells=5, order=3))} == {(5, 3)}
    assert len(rungs(FieldSettings(tolerance=0.1, order=3, shells=5, resolution=4, proxies=2))) == 1


def test_objects_move_where_nothing_stands(scene):
    loaded = load_scene(scene)
    geometry = build_geometry(loaded)
    seen = set()
    for turn in (*TRIAL, CHECK):
        moves = free_moves(loaded, geometry, turn)
        assert [move.partition("=")[0] for move in moves] == ["ball", "block"]
        moved = move_geometry(geometry, loaded, apply_moves(loaded, moves))
        boxes = []
        for name in ("ball", "block"):
            own = moved.vertex_object == moved.object_names.index(name)
            way = (moved.positions[own] - geometry.positions[own])[0]
            assert way[1] == 0.0
            assert np.linalg.norm(way) > 0.5
            seen.add((name, *np.round(way, 6)))
            boxes.append((moved.positions[own].min(0), moved.positions[own].max(0)))
        (low, high), (other_low, other_high) = boxes
        assert (low > other_high).any() or (high < other_low).any()
    assert len(seen) == 6


def test_only_what_can_be_edited_is():
    red, blue = lambert((0.9, 0.2, 0.1)), lambert((0.1, 0.2, 0.9))
    materials = {"a": type(red)("a", diffuse=red.diffuse, adjustable=True), "b": blue}
    assert edit_of(materials, {"b"}) is None
    changed = edit_of(materials, {"a", "b"})
    assert changed is not None
    assert changed["a"].diffuse == (0.2, 0.1, 0.9)
    assert changed["b"] is blue


def test_a_tolerance_out_of_range_is_refused(scene, tmp_path):
    with pytest.raises(InputError, match="--tolerance"):
        run(scene, tmp_path / "t.zarr", tolerance=1.0)

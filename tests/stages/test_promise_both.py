"""--tolerance where there are characters and objects that may be moved: fields chosen without the characters, models of
them with the objects in other places, and what is said of a miss."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import relight_formats as formats
from relightcli.adapters.images import write_image
from relightcli.core.lights.sky import sky_latlong
from relightcli.errors import NumericalError
from relightcli.stages import measured_error
from relightcli.stages.fit_pose import Config, fit_pose
from relightcli.stages.promise_moving import CHOSEN, _Thinned
from relightcli.stages.promise_pose import CHECK, TRIAL, places_between
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.stages.pose_files import SCENE
from tests.stages.scene_files import make_store, read_layers
from tests.stages.test_posed_moving import BALL
from tests.stages.test_posed_scene import make_scene

SMALL = {"light_resolution": 16, "pose_directions": 64, "bounces": 0, "subdivide": False, "workers": 1}
FIELDS = {"field_shells": 4, "field_resolution": 4, "field_proxies": 2}
TOLERANCE = 0.4


@pytest.fixture(scope="module")
def transfer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both")
    path = make_scene(folder, SCENE + BALL.replace("[3.5, 0.6, -3.5]", "[1.2, 0.6, 0.8]"))
    trimesh.creation.icosphere(subdivisions=2, radius=0.5).export(folder / "ball.obj")
    return make_store(path, tolerance=TOLERANCE, **SMALL, **FIELDS)


def fit(transfer, name, **settings):
    output = transfer.parent / name
    return fit_pose(Config(store=transfer, output=output, quiet=True, workers=1, **settings)), output


def test_fields_are_chosen_without_characters(transfer):
    store = formats.open_store(transfer)
    assert "measured_error" not in store.attrs  # of characters it is known once they can be posed
    (*_, last) = store.attrs["fields_tried"]
    assert last["share"] <= CHOSEN * TOLERANCE

    class Opened:
        settings, attrs, layouts, path, partial_path = store.settings, store.attrs, store.layouts, None, None
        read = staticmethod(store.read)

    bar = list(store.attrs["scene"]["objects"]).index("bar")
    faces, owner = (_Thinned(Opened, (bar,)).read(f"mesh/{name}") for name in ("face", "face_object"))
    np.testing.assert_array_equal(faces, store.read("mesh/face")[store.read("mesh/face_object") != bar])
    assert bar not in owner


def test_both_keep_it(transfer):
    done, output = fit(transfer, "kept.zarr")
    measured = formats.open_store(output).attrs["measured_error"]
    assert done["measured_error"] == measured["share"] <= TOLERANCE
    # A pose, a place and a sky that neither the choice nor the check knows.
    sky = output.parent / "sun.exr"
    write_image(sky, sky_latlong(42.0, 310.0, size=(64, 128)))
    given = {"env": str(sky), "poses": ("bar=bend@0.91",), "moves": ("ball=0.9,0.7,1.1",), "quiet": True, "workers": 1}
    pictures = [output.parent / f"{k}.exr" for k in "sab"]
    relight(RelightConfig(store=output, output=str(pictures[0]), **given))
    for seed, path in enumerate(pictures[1:]):
        truth = {"store": output, "reference": True, "spp": 64, "bounces": 3, "seed": seed}
        relight(RelightConfig(output=str(path), **truth, **given))
    s, a, b = (read_layers(path)[""].astype(float) for path in pictures)
    assert np.sqrt(max(((s - a) * (s - b)).sum(), 0.0) / (a * b).sum()) <= TOLERANCE
    assert fit(transfer, "kept.zarr")[0]["status"] == "up to date"


def test_a_miss_names_both(transfer, monkeypatch):
    monkeypatch.setattr(measured_error, "MOST_TIMES", 1)  # far off is far off
    with pytest.raises(NumericalError, match=r"more than the tolerance of 0\.20%.*--pose-.*--field-order 5"):
        fit(transfer, "miss.zarr", tolerance=0.002)


def test_every_second_picture_has_objects_elsewhere(transfer):
    store = formats.open_store(transfer)
    trial, check = places_between(store, TRIAL), places_between(store, CHECK)
    assert [len(moves) for _, moves in trial] == [len(moves) for _, moves in check] == [0, 1]
    assert trial[1][1] != check[1][1]
    assert all(moves[0].startswith("ball=") for _, moves in (trial[1], check[1]))

"""precompute --tolerance: settings that keep it, the error measured at the end, and what is said where it is missed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

import relight_formats as formats
from relightcli.adapters.images import write_image
from relightcli.errors import InputError, NumericalError
from relightcli.scene.model import Camera, Material
from relightcli.scene.shapes import lathe
from relightcli.stages.measured_error import check_skies, edited, rows_of, trial_skies
from relightcli.stages.precompute import precompute
from relightcli.stages.precompute_config import Config
from relightcli.stages.relight import Config as RelightConfig
from relightcli.stages.relight import relight
from tests.core.transport.scenes import Part, lambert, sphere, square
from tests.stages.scene_files import read_layers, write_scene

CAMERA = Camera("main", (0, 1.6, 2.6), (0, 0.3, 0), fov=40, size=(40, 30))


def grid(size, cells, material):
    """A square in the xz plane of cells x cells."""
    x = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    corners = np.array([(u, 0.0, -v) for v in x for u in x])
    k = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Part(corners, faces, np.tile([0.0, 1.0, 0.0], (len(corners), 1)), material=material)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    parts = {"ground": grid(3, 40, lambert((0.5, 0.4, 0.3))), "ball": sphere(0.4, (0, 0.5, 0), rings=24)}
    parts["ball"].material = lambert((0.6, 0.5, 0.2))
    return write_scene(tmp_path_factory.mktemp("promise"), parts, [CAMERA], {}, adjustable=True)


def run(scene, output, **settings):
    return precompute(Config(scene, output, quiet=True, **{"workers": 1, "subdivide": False, **settings}))


def true_error(store, name, sky, transfer=None):
    """Relative RMS of the picture of a sky against path tracing of all bounces, its noise taken off by two runs.

    transfer: the store whose scene is traced, if `store` does not hold it."""
    write_image(store.parent / f"{name}.exr", sky)
    given = {"env": str(store.parent / f"{name}.exr"), "quiet": True, "workers": 1}
    out = [store.parent / f"{name}-{k}.exr" for k in ("ours", "a", "b")]
    relight(RelightConfig(store=store, output=str(out[0]), **given))
    for seed, path in enumerate(out[1:]):
        truth = {"store": transfer or store, "reference": True, "spp": 128, "bounces": 8, "seed": seed}
        relight(RelightConfig(output=str(path), **truth, **given))
    s, a, b = (read_layers(path)[""].astype(float) for path in out)
    return np.sqrt(max(((s - a) * (s - b)).sum(), 0.0) / (a * b).sum())


def test_error_is_measured_and_is_the_true_one(scene, tmp_path):
    run(scene, tmp_path / "t.zarr", tolerance=0.1)
    store = formats.open_store(tmp_path / "t.zarr")
    measured, tried = store.attrs["measured_error"], store.attrs["tried"]
    assert measured["share"] <= measured["tolerance"] == 0.1
    assert measured["share"] <= measured["bound"]
    assert [t["light_resolution"] for t in tried] == [16, 32, 64, 128][: len(tried)]
    assert store.settings["light_resolution"] == tried[-1]["light_resolution"]
    assert all(t["share"] > 0.08 for t in tried[:-1])
    assert tried[-1]["share"] <= 0.08
    skies = check_skies()
    some = ("sun at 50 degrees", "sun at 20 degrees", "overcast", "dusk")
    found = {name: true_error(tmp_path / "t.zarr", name.replace(" ", "-"), skies[name]) for name in some}
    # Another view, and other pixels of it.
    assert max(found.values()) == pytest.approx(measured["share"], rel=0.5)
    assert max(found.values()) <= 0.1


def test_level_light_is_seen_to_fall_between_vertices(tmp_path):
    """A vase of five rows of vertices: what comes in level or from below is lost between the lowest two, under a sky
    that the check does not have as well."""
    corners, faces = lathe([(0.25, 0.0), (0.45, 0.3), (0.4, 0.6), (0.15, 0.9), (0.25, 1.1)], 48)
    smooth = np.array(trimesh.Trimesh(corners, faces, process=False).vertex_normals)
    plastic = Material("", "blinn-phong", (0.2, 0.3, 0.5), (0.15, 0.15, 0.15), shininess=40.0)
    vase = Part(corners, faces, smooth, material=plastic)
    parts = {"vase": vase, "ground": grid(3, 24, lambert((0.45, 0.4, 0.35)))}
    path = write_scene(tmp_path, parts, [CAMERA], {})
    store = tmp_path / "t.zarr"
    run(path, store, tolerance=0.05, light_resolution=32, bounces=1, allow_miss=True)
    measured = formats.open_store(store).attrs["measured_error"]
    assert "dusk" in measured["where"]
    latitude = 90.0 - 180.0 * (np.arange(64) + 0.5) / 64
    band = 0.05 + np.exp(-((latitude / 10.0) ** 2))[:, None, None] * np.tile([0.5, 1.0, 2.0], (1, 128, 1))
    found = true_error(store, "band", band.astype(np.float32))
    assert found > 0.05
    assert measured["share"] > 0.8 * found  # a fifth for the other view


def test_some_low_sun_stands_behind_the_scene():
    """Whatever a camera's azimuth, what is dark in its picture, and full of shadows, is in a trial and in the check."""
    for skies in (check_skies(), trial_skies()):
        low = []
        for name, sky in skies.items():
            if "sun" in name:
                row, column = np.unravel_index(sky.sum(axis=2).argmax(), sky.shape[:2])
                if 90.0 - 180.0 * (row + 0.5) / len(sky) < 25.0:
                    low.append(180.0 - 360.0 * (column + 0.5) / sky.shape[1])
        apart = [min(abs((azimuth - sun + 180.0) % 360.0 - 180.0) for sun in low) for azimuth in range(360)]
        assert max(apart) < 65.0


def test_a_smaller_tolerance_takes_more(scene, tmp_path):
    coarse = run(scene, tmp_path / "c.zarr", tolerance=0.3, dry_run=True)
    fine = run(scene, tmp_path / "f.zarr", tolerance=0.03, dry_run=True)
    assert coarse["light_resolution"] < fine["light_resolution"]
    assert coarse["bounces"] <= fine["bounces"]
    assert coarse["predicted"]["rays"] < fine["predicted"]["rays"]
    assert list(tmp_path.iterdir()) == []


def test_a_miss_is_told_and_may_be_allowed(tmp_path):
    # A ground of two triangles carries no shadow.
    parts = {"ground": square(3, material=lambert(0.5)), "ball": sphere(0.4, (0, 0.5, 0), rings=24)}
    bad = write_scene(tmp_path, parts, [CAMERA], {})
    store = tmp_path / "t.zarr"
    said = r"more than the tolerance of 2\.00%.*--receivers pixels:main.*{}.*allow-miss"
    # Direct light alone tells, so that nothing is simulated; with all settings given it is found out at the end.
    with pytest.raises(NumericalError, match=said.format("Nothing was simulated")):
        run(bad, store, tolerance=0.02)
    assert any("direct light alone errs" in note for note in run(bad, store, tolerance=0.02, dry_run=True)["notes"])
    late = tmp_path / "late.zarr"
    with pytest.raises(NumericalError, match=said.format("work is kept")):
        run(bad, late, tolerance=0.02, light_resolution=16, bounces=0)
    assert not late.exists()
    assert run(bad, late, tolerance=0.02, light_resolution=16, bounces=0, allow_miss=True)["status"] == "resumed"
    assert not store.exists()
    done = run(bad, store, tolerance=0.02, allow_miss=True)
    assert done["status"] == "written"
    measured = formats.open_store(store).attrs["measured_error"]
    assert measured["share"] > 0.1
    assert run(bad, store, tolerance=0.02)["status"] == "up to date"
    # What it says helps.
    run(bad, tmp_path / "p.zarr", tolerance=0.05, receivers="pixels:main")
    assert formats.open_store(tmp_path / "p.zarr").attrs["measured_error"]["share"] <= 0.05


def test_resolution_that_is_asked_for_stays(scene, tmp_path):
    assert run(scene, tmp_path / "t.zarr", tolerance=0.3, light_resolution=32, dry_run=True)["light_resolution"] == 32
    assert run(scene, tmp_path / "t.zarr", dry_run=True)["light_resolution"] == 64
    with pytest.raises(InputError, match="--tolerance"):
        run(scene, tmp_path / "t.zarr", tolerance=0.0)


def test_rows_are_spread_over_the_picture():
    assert rows_of(CAMERA) == [(0, 30)]
    rows = rows_of(Camera("c", (0, 0, 1), (0, 0, 0), size=(128, 96)))
    assert rows == [(10, 14), (34, 38), (58, 62), (82, 86)]
    for width, height in ((1, 100_000), (100_000, 1), (640, 480), (3, 3)):
        rows = rows_of(Camera("c", (0, 0, 1), (0, 0, 0), size=(width, height)))
        assert rows[0][0] >= 0
        assert rows[-1][1] <= height
        assert all(a[1] <= b[0] for a, b in itertools.pairwise(rows))


def test_edits_change_what_may_be_changed():
    red = lambert((0.9, 0.2, 0.1))
    changed = edited({"a": red, "b": type(red)("b", diffuse=(0.9, 0.2, 0.1), adjustable=True)})
    assert changed["a"] is red
    assert changed["b"].diffuse == (0.2, 0.1, 0.9)

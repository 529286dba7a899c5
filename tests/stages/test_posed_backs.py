"""Backs of posed membranes and two-sided surfaces: a sheet that folds, lit from behind."""

from __future__ import annotations

import numpy as np
import pytest

import relight_formats as formats
from relightcli.adapters.flip import flip_hdr
from relightcli.adapters.images import write_image
from relightcli.adapters.rays import Tracer
from relightcli.core.measure.errors import relative_rmse
from relightcli.core.pose.visibility import hemisphere_directions
from relightcli.errors import StoreError
from relightcli.stages.fit_pose import Config as FitConfig
from relightcli.stages.fit_pose import fit_pose
from relightcli.stages.posed import PoseStore
from tests.stages.pose_files import COLUMNS, ROWS, sheet
from tests.stages.scene_files import make_store, read_layers
from tests.stages.test_fit_pose import SMALL, fit, render

SCENE = """format = 1
[objects.cape]
mesh = "cape.glb"
material = "cloth"
motion = "skinned"
{sides}
[materials.cloth]
{material}
[environments.sky]
map = "sky.exr"
[cameras.front]
eye = [1.2, 1.6, 5]
target = [0, 0.8, 0]
size = [32, 32]
[cameras.behind]
eye = [-1.2, 1.9, -5]
target = [0, 0.8, 0]
size = [32, 32]
"""
TWO = "two_sided = true"
MEMBRANE = 'model = "translucent"\ndiffuse = [0.3, 0.2, 0.2]\ntransmittance = [0.5, 0.5, 0.4]'
PHONG = 'model = "phong"\ndiffuse = [0.3, 0.2, 0.2]\nspecular = [0.4, 0.4, 0.5]\nshininess = 12'
WHITE = "diffuse = [1, 1, 1]"
BACK, FORTH = "cape=bend@0.7", "cape=bend@3.2"  # by 78 and 72 degrees: 12 from the nearest training frame


def scene_of(folder, material, sides="", even=False, **shape):
    """The scene file; under a sky that is bright behind the sheet, or 1 everywhere."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet(folder / "cape.glb", **shape)
    lat = np.pi * (0.5 - (np.arange(32) + 0.5) / 32)[:, None]
    lon = np.pi * (1 - 2 * (np.arange(64) + 0.5) / 64)[None, :]
    up, back = np.sin(lat) + 0 * lon, -np.cos(lon) * np.cos(lat)
    sky = 0.3 + 0.3 * up[..., None] + np.maximum(0.4 * up + 0.9 * back, 0)[..., None] ** 2 * np.array([1.5, 1.2, 0.9])
    write_image(folder / "sky.exr", np.ones((4, 8, 3), np.float32) if even else sky.astype(np.float32))
    (folder / "scene.toml").write_text(SCENE.format(material=material, sides=sides))
    return folder / "scene.toml"


@pytest.fixture(scope="module")
def membrane(tmp_path_factory):
    scene = scene_of(tmp_path_factory.mktemp("membrane"), MEMBRANE)
    return scene, fit(make_store(scene, **SMALL))


@pytest.fixture(scope="module")
def white(tmp_path_factory):
    scene = scene_of(tmp_path_factory.mktemp("white"), WHITE, TWO, even=True)
    return fit(make_store(scene, **SMALL))


def compare(scene, store, camera, pose):
    """FLIP and relative RMS error of a picture and, where there are any, of its highlights."""
    asked = {"poses": (pose,), "camera": camera, "layers": True}
    ours, truth = (
        read_layers(render(source, f"{name}.exr", **asked, **more)[0])
        for source, name, more in ((store, "ours", {}), (scene, "truth", {"reference": True, "spp": 100}))
    )
    shine = relative_rmse(ours["specular"], truth["specular"]) if np.any(truth["specular"]) else None
    return flip_hdr(ours[""], truth[""]).mean(), relative_rmse(ours[""], truth[""]), shine


@pytest.mark.parametrize("pose", [BACK, FORTH])
def test_a_membrane_that_is_lit_from_behind(membrane, pose):
    """FLIP of 0.06 under smooth skies is what was set out to be reached. Relative: four bands lose some 4 % of a
    diffuse picture; measured 0.039 and 0.035, and 0.165 folded back as long as backs saw all of the sky."""
    flip, relative, _ = compare(*membrane, "front", pose)
    assert flip < 0.06
    assert relative < 0.06


def test_both_sides_shine(tmp_path):
    """From behind, diffuse light and highlights. Measured: 0.049 and 0.048 of the picture, 0.065 and 0.060 of the
    highlights; what is sharp in a lobe of four bands comes on top of what `test_a_membrane_...` allows."""
    scene = scene_of(tmp_path, PHONG, TWO)
    store = fit(make_store(scene, **SMALL))
    for pose in (BACK, FORTH):
        flip, relative, shine = compare(scene, store, "behind", pose)
        assert flip < 0.06
        assert relative < 0.08
        assert shine < 0.1


@pytest.mark.parametrize("pose", [BACK, FORTH])
def test_irradiance_against_quadrature(white, pose):
    """White and lit evenly, so that exit radiance is int V cos / pi of either side, here by rays: 2048, whose lattice
    errs by some 3e-3. The rest is the model's: 0.015 to 0.026 when this was written, as what a side sees bends where
    it begins to see itself. With a back that sees all of the sky it would be 0.1 within the fold."""
    output, _ = render(white, "white.zarr", poses=(pose,), overwrite=True)
    found = formats.open_store(output).read("radiance")[0, :, 0]
    opened = PoseStore(white, 1)
    opened.set_poses((pose,))
    tracer = Tracer(opened.geometry.positions, opened.geometry.faces)
    local = hemisphere_directions(2048)
    truth = np.empty(len(found))
    for k, (position, normal) in enumerate(zip(opened.position, opened.normal.astype(float), strict=True)):
        across = np.cross(normal, [1.0, 0, 0])
        frame = np.stack([np.cross(across, normal), across, normal])
        origin = np.repeat(tracer.offset(position[None], normal[None]), len(local), axis=0)
        frees = ~tracer.occluded(origin, (local @ frame).astype(np.float32))
        truth[k] = 2.0 * np.mean(frees * local[:, 2])
    for side in (1, -1):
        own = opened.side == side
        inside = side == (-1 if pose == BACK else 1)
        assert (truth[own].min() < 0.9) == inside
        assert np.sqrt(np.mean((found - truth)[own] ** 2)) < 0.03


def test_a_flat_sheet_in_a_furnace(tmp_path):
    """A sheet that never bends hides nothing of an even sky from either side: exit radiance is reflectance and
    transmittance, which four bands of a hemisphere times a cosine have exactly. Stored numbers are rounded by 5e-4."""
    scene = scene_of(tmp_path, MEMBRANE, even=True, degrees=np.zeros(9))
    store = fit(make_store(scene, **SMALL))
    for model in ({}, {"weight": "cosine"}):
        store = fit(store.parent / "transfer.zarr", f"{model}.zarr", **model)
        output, _ = render(store, f"furnace{model}.zarr", poses=("cape=bend@1.3",))
        radiance = formats.open_store(output).read("radiance")[0]
        front = formats.open_store(store).read("receivers/side") > 0
        assert front.sum() == ROWS * COLUMNS == (~front).sum()
        np.testing.assert_allclose(radiance[front], np.tile([0.8, 0.7, 0.6], (front.sum(), 1)), rtol=2e-3)


def test_only_lit_backs_are_paid_for(membrane, tmp_path):
    scene = scene_of(tmp_path, WHITE)
    plain = make_store(scene, **SMALL)
    sizes = []
    for path, sides in ((plain, 1), (membrane[0].parent / "transfer.zarr", 2)):
        store = formats.open_store(path)
        assert store.attrs["poses"]["0"]["sides"] == sides
        assert store.layouts["pose/0/visibility"].shape[1] == sides * ROWS * COLUMNS
        summary = fit_pose(FitConfig(store=path, output=tmp_path / f"{sides}.zarr", quiet=True))["objects"][0]
        assert (summary["vertices"], summary["sides"]) == (ROWS * COLUMNS, sides)
        sizes.append(summary["bytes"])
    assert 1.3 * sizes[0] < sizes[1] < 2.5 * sizes[0]
    # Fronts are what they are without backs beside them.
    alone, beside = (
        formats.open_store(s).read("pose/0/visibility") for s in (plain, membrane[0].parent / "transfer.zarr")
    )
    assert np.array_equal(alone, beside[:, : ROWS * COLUMNS])


def test_a_model_of_fronts_does_not_light_backs(membrane):
    store = formats.open_store(membrane[1])
    store.attrs["pose_models"]["0"]["sides"] = 1
    with pytest.raises(StoreError, match=r"pose/0/model: expected 2 x 91 rows.*Precompute and fit it again"):
        PoseStore(store, 1).set_poses((BACK,))

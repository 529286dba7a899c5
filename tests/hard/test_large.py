"""A million triangles."""

from __future__ import annotations

import numpy as np
import pytest

from relightcli.scene.model import Camera
from tests.core.transport.scenes import Part, lambert
from tests.stages.scene_files import make_store, picture, write_scene


@pytest.mark.slow
def test_a_million_triangles(tmp_path, within):
    """A flat sheet of 708 x 708 cells, seen by 64 pixels: under an even sky its albedo, 1 % for 16 texels a side, as of
    two triangles; and no light falls between the triangles, which would be seen as a pixel that is not opaque."""
    import trimesh

    n = 708
    x = np.linspace(-1.0, 1.0, n + 1)
    corners = np.stack([*np.meshgrid(x, [0.0], x, indexing="ij")], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (i * (n + 1) + j).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n + 1], -1), np.stack([a + 1, a + n + 2, a + n + 1], -1)])
    assert len(faces) > 1_000_000
    camera = Camera("main", (0.1, 2.0, 0.3), (0.0, 0.0, 0.0), fov=30, size=(8, 8))
    one = Part(np.array([[-1.0, 0, 1], [1, 0, 1], [0, 0, -1]]), np.array([[0, 1, 2]]), material=lambert(0.5))
    scene = write_scene(tmp_path, {"sheet": one}, [camera], {"even": np.ones((4, 8, 3))})
    trimesh.Trimesh(corners, faces, process=False).export(tmp_path / "sheet.ply")
    scene.write_text(scene.read_text().replace("sheet.obj", "sheet.ply"))
    store = make_store(scene, light_resolution=16, subdivide=False, receivers="pixels:main")
    rgb, alpha = picture(store)
    assert (alpha == 1).all()
    within("albedo of the sheet", float(np.abs(rgb / 0.5 - 1).max()), 0.01)

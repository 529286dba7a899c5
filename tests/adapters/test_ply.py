"""PLY: another reader finds the same vertices, faces and colours, and the exact radiance."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal

from relightcli.adapters.ply import write_ply
from relightcli.core.display import to_display
from relightcli.errors import InputError

POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
RADIANCE = np.array([[0, 0.1, 0.2], [1, 2, 3], [0.5, 0.5, 0.5], [1e6, 0, 1e-6]], np.float32)


def test_trimesh_reads_it_back(tmp_path):
    write_ply(tmp_path / "a.ply", POSITIONS, FACES, RADIANCE, exposure=-1)
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    assert_array_equal(mesh.vertices, POSITIONS)
    assert_array_equal(mesh.faces, FACES)
    assert_array_equal(mesh.visual.vertex_colors[:, :3], to_display(RADIANCE / 2))
    raw = mesh.metadata["_ply_raw"]["vertex"]["data"]
    for axis, name in enumerate(("radiance_r", "radiance_g", "radiance_b")):
        assert_array_equal(np.ravel(raw[name]), RADIANCE[:, axis])


def test_no_faces_and_no_vertices(tmp_path):
    empty = np.zeros((0, 3))
    write_ply(tmp_path / "a.ply", empty, empty.astype(int), empty)
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()


def test_shapes_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(InputError, match="radiance"):
        write_ply(tmp_path / "a.ply", POSITIONS, FACES, RADIANCE[:3])
    with pytest.raises(InputError, match="faces"):
        write_ply(tmp_path / "a.ply", POSITIONS, FACES[:, :2], RADIANCE)
    assert not (tmp_path / "a.ply").exists()

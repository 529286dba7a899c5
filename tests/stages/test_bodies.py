import numpy as np
import trimesh

from relightcli.scene.model import Material
from relightcli.stages.bodies import body_of


def made(*parts):
    mesh = trimesh.util.concatenate(parts)
    positions, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    normals, white = np.asarray(mesh.vertex_normals, np.float32), np.ones((len(positions), 3), np.float32)
    return body_of(positions, normals, faces, False, white, Material("white", diffuse=(1.0, 1.0, 1.0)), 4)


def test_points_inside_another_part_step_out():
    """A column whose ends are in two slabs that reach to 0.8: its corners at 1 speak from between the slabs."""
    slabs = [trimesh.creation.box((1, 0.4, 1)) for _ in range(2)]
    slabs[0].apply_translation((0, 1, 0))
    slabs[1].apply_translation((0, -1, 0))
    body = made(trimesh.creation.box((0.3, 2, 0.3)), *slabs)
    column = body.vertex < 8
    assert column.sum() == 8
    assert (np.abs(body.positions[body.vertex[column], 1]) == 1.0).all()
    assert (np.abs(body.point[column, 1]) < 0.8).all()
    assert (np.abs(body.point[column][:, [0, 2]]).max(axis=1) <= 0.15 + 1e-9).all()
    np.testing.assert_array_equal(body.point[~column], body.positions[body.vertex[~column]])


def test_points_of_convex_objects_stay():
    for mesh in (trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(2)):
        body = made(mesh)
        np.testing.assert_array_equal(body.point, body.positions[body.vertex])

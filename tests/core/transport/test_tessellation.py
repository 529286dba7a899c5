"""Cutting large faces: the shape stays, faces stay joined, edges get short where shadows fall."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from relightcli.core.transport import tessellation
from relightcli.core.transport.tessellation import NEAR_PARTS, OBJECT_PARTS, SLOPE, tessellate
from relightcli.scene.model import Geometry


def scene(*meshes: trimesh.Trimesh) -> Geometry:
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    vertices = sum(len(m.vertices) for m in meshes)
    return Geometry(
        tuple(f"o{k}" for k in range(len(meshes))),
        np.concatenate([m.vertices for m in meshes]).astype(np.float64),
        np.concatenate([m.vertex_normals for m in meshes]).astype(np.float32),
        np.full((vertices, 2), np.nan, np.float32),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=False)]).astype(np.int32),
        np.concatenate([np.full(len(m.vertices), k) for k, m in enumerate(meshes)]).astype(np.int32),
        np.concatenate([np.full(len(m.faces), k) for k, m in enumerate(meshes)]).astype(np.int32),
        np.zeros(len(meshes), np.int32),
        np.zeros(len(meshes), bool),
        {},
    )


def quad(half: float) -> trimesh.Trimesh:
    corners = [[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]]
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def ball(radius: float, height: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(3, radius=radius)
    mesh.apply_translation([0, height, 0])
    return mesh


def cross(g: Geometry) -> NDArray[np.float64]:
    p = g.positions[g.faces]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def edges(g: Geometry, owner: int) -> NDArray[np.int64]:
    f = g.faces[g.face_object == owner]
    return np.sort(np.stack([f, np.roll(f, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)


@pytest.fixture(scope="module")
def before() -> Geometry:
    return scene(quad(2.0), ball(0.3, 0.4))


@pytest.fixture(scope="module")
def after(before: Geometry) -> Geometry:
    return tessellate(before)


def test_first_vertices_stay(before: Geometry, after: Geometry) -> None:
    n = len(before.positions)
    assert len(after.positions) > n + 500
    np.testing.assert_array_equal(after.positions[:n], before.positions)
    np.testing.assert_array_equal(after.normals[:n], before.normals)
    assert (np.diff(after.face_object) >= 0).all()
    np.testing.assert_array_equal(after.vertex_object[after.faces[:, 0]], after.face_object)


def test_area_and_winding_stay(before: Geometry, after: Geometry) -> None:
    for owner in (0, 1):
        area = [0.5 * np.linalg.norm(cross(g)[g.face_object == owner], axis=1).sum() for g in (before, after)]
        assert area[1] == pytest.approx(area[0], rel=1e-12)  # rounding of sums of doubles
    assert (cross(after)[after.face_object == 0][:, 1] > 0).all()


def test_faces_stay_joined(after: Geometry) -> None:
    """No T-junctions: inner edges have two faces, and only the quad's rim has edges with one."""
    unique, count = np.unique(edges(after, 0), axis=0, return_counts=True)
    assert count.max() == 2
    rim = after.positions[unique[count == 1]]
    assert (np.isclose(np.abs(rim[..., [0, 2]]), 2.0).any(axis=2)).all()
    assert (np.unique(edges(after, 1), axis=0, return_counts=True)[1] == 2).all()


def test_edges_keep_their_limit(before: Geometry, after: Geometry) -> None:
    pair = np.unique(edges(after, 0), axis=0)
    p = after.positions[pair]
    length = np.linalg.norm(p[:, 0] - p[:, 1], axis=1)
    ball_points = before.positions[before.vertex_object == 1]
    middle = p.mean(axis=1)
    distance = np.linalg.norm(middle[:, None] - ball_points[None], axis=2).min(axis=1)
    diagonal = np.linalg.norm(np.ptp(ball_points, axis=0))
    limit = np.minimum(np.sqrt(32.0) / OBJECT_PARTS, np.maximum(diagonal / NEAR_PARTS, SLOPE * distance))
    assert (length <= limit * (1 + 1e-9)).all()
    # Not much finer than asked: halving overshoots by 2, Rivara's closure by a little more.
    assert np.median(length / limit) > 0.4


def test_angles_stay_bounded(after: Geometry) -> None:
    """Longest-edge bisection keeps at least half of the smallest angle, 45 degrees here. [Rivara 1984]"""
    p = after.positions[after.faces[after.face_object == 0]]
    e = p - np.roll(p, -1, axis=1)
    e /= np.linalg.norm(e, axis=2, keepdims=True)
    cosine = -np.einsum("fkx,fkx->fk", e, np.roll(e, 1, axis=1))
    assert np.degrees(np.arccos(cosine.max())) > 22.5 - 1e-6


def test_fine_meshes_and_a_second_time_change_nothing(after: Geometry) -> None:
    fine = scene(trimesh.creation.icosphere(5))
    assert tessellate(fine) is fine
    again = tessellate(after)
    # The limit looks at vertices of other objects, of which there are now more: a few edges may still be cut.
    assert len(again.positions) <= 1.1 * len(after.positions)


def test_scale_does_not_matter(before: Geometry, after: Geometry) -> None:
    for scale in (2.0**-20, 2.0**20):
        scaled = tessellate(scene(quad(2.0 * scale), ball(0.3 * scale, 0.4 * scale)))
        assert len(scaled.positions) == len(after.positions)


def test_budget(monkeypatch: pytest.MonkeyPatch, before: Geometry) -> None:
    monkeypatch.setattr(tessellation, "MOST_NEW_VERTICES", 300)
    # once for each of the two passes
    assert len(before.positions) < len(tessellate(before).positions) <= len(before.positions) + 600


def test_degenerate_faces_and_points_at_one_place() -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0]], [[0, 1, 2], [0, 3, 0]], process=False)
    out = tessellate(scene(quad(1.0), flat))
    assert np.isfinite(out.positions).all()
    assert np.isfinite(out.normals).all()

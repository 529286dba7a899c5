"""Parametric surfaces with shared vertices: what the built-in demo scene is made of. Metres, +Y up, fronts outwards."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]  # positions (V, 3), faces (F, 3)


def patch(points: NDArray[np.float64], *, wrap_u: bool = False, wrap_v: bool = False) -> Mesh:
    """Triangles over a grid of points (U, V, 3); fronts look along d/du x d/dv. `wrap_*` joins last to first."""
    rows, columns = points.shape[:2]
    u = np.arange(rows if wrap_u else rows - 1)[:, None]
    v = np.arange(columns if wrap_v else columns - 1)[None, :]
    a, b = u * columns + v, (u + 1) % rows * columns + v
    c, d = (u + 1) % rows * columns + (v + 1) % columns, u * columns + (v + 1) % columns
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return points.reshape(-1, 3), faces.reshape(-1, 3)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, vertices kept apart."""
    starts = np.cumsum([0] + [len(p) for p, _ in meshes[:-1]])
    return (
        np.concatenate([p for p, _ in meshes]),
        np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=True)]),
    )


def rounded(size: Sequence[float], *, power: float, round_plan: bool = False, subdivisions: int = 4) -> Mesh:
    """A box with soft edges, |x/a|^p + |y/b|^p + |z/c|^p = 1, standing on the ground.

    size: full extents; power p: 2 is an ellipsoid, large is a box. With `round_plan` x and z enter by their radius
    sqrt(x^2 + z^2): a cylinder with soft edges.
    """
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    direction = np.asarray(sphere.vertices)
    parts = np.abs(direction)
    if round_plan:
        parts = np.stack([np.hypot(direction[:, 0], direction[:, 2]), parts[:, 1]], axis=1)
    radius = (parts**power).sum(axis=1) ** (-1.0 / power)
    half = 0.5 * np.asarray(size)
    return direction * radius[:, None] * half + np.array([0.0, half[1], 0.0]), np.asarray(sphere.faces)


def tube(centers: NDArray[np.float64], radius: float, sides: int) -> Mesh:
    """A closed tube around a closed curve (N, 3) that does not pass near the origin."""
    ahead, behind = np.roll(centers, -1, axis=0), np.roll(centers, 1, axis=0)
    tangent = ahead - behind
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # A frame that needs no history, so that the ends meet: the direction from the origin, made square to the curve.
    binormal = np.cross(tangent, centers)
    binormal /= np.linalg.norm(binormal, axis=1, keepdims=True)
    normal = np.cross(binormal, tangent)
    angle = 2 * math.pi * np.arange(sides) / sides
    ring = np.cos(angle)[None, :, None] * normal[:, None] + np.sin(angle)[None, :, None] * binormal[:, None]
    return patch((centers[:, None] + radius * ring)[:, ::-1], wrap_u=True, wrap_v=True)


def torus_knot(p: int, q: int, major: float, minor: float, segments: int) -> NDArray[np.float64]:
    """Points (segments, 3) of the (p, q) torus knot around +Z."""
    t = 2 * math.pi * np.arange(segments) / segments
    r = major + minor * np.cos(q * t)
    return np.stack([r * np.cos(p * t), r * np.sin(p * t), minor * np.sin(q * t)], axis=1)


def lathe(profile: Sequence[tuple[float, float]], segments: int) -> Mesh:
    """An open surface of revolution around +Y; profile: (radius, height) from the bottom up."""
    radius, height = np.array(profile).T
    angle = 2 * math.pi * np.arange(segments) / segments
    x, z = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    points = np.stack([x, np.broadcast_to(height[:, None], x.shape), z], axis=-1)
    return patch(points, wrap_v=True)


def arc_beam(radius: float, width: float, low: float, high: float, start: float, stop: float, segments: int) -> Mesh:
    """A bar of rectangular section along an arc around +Y, sharp edges, from angle `start` to `stop` (radians from +X
    towards -Z), standing between the heights `low` and `high`."""
    angle = np.linspace(start, stop, segments + 1)
    inner, outer = radius - width / 2, radius + width / 2
    corners = [(inner, low), (outer, low), (outer, high), (inner, high)]

    def point(r: NDArray[np.float64], y: NDArray[np.float64], a: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(r * np.cos(a), y, -r * np.sin(a)), axis=-1)

    def between(a: tuple[float, float], b: tuple[float, float], n: int) -> tuple[NDArray[np.float64], ...]:
        return np.linspace(a[0], b[0], n), np.linspace(a[1], b[1], n)

    sides = []
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        r, y = between(a, b, 4)
        sides.append(patch(point(r[None, :], y[None, :], angle[:, None])))
    r, y = np.linspace(inner, outer, 4), np.linspace(low, high, 4)
    ends = [
        patch(point(r[:, None], y[None, :], np.full((1, 1), start))),
        patch(point(r[::-1, None], y[None, :], np.full((1, 1), stop))),
    ]
    return join(sides + ends)

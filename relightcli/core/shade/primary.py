"""What each pixel of a camera sees first: samples on a regular grid, on a finer one where the picture has edges.

An edge is where neighbouring samples see different objects, depths or slopes. The result depends on the camera and the
geometry only: every further sky reuses it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.transport.camera import Film, film_direction
from relightcli.core.transport.tracer import Tracer

BASE_GRID = 1  # samples along a pixel's side; receivers' light is smooth between them
EDGE_GRID = 6  # the same where the picture has an edge
TEXTURE_GRID = 3  # the least where surfaces have textures


@dataclass(frozen=True)
class Samples:
    """Camera samples that hit something, sorted by pixel.

    pixel (N,) int32 flat index; weight (N,) float32, 1 / samples of the pixel; face (N,) int32; u, v (N,) float32;
    direction (N, 3) float32 unit, from the eye to the surface; coverage (H, W) float32.
    """

    pixel: NDArray[np.int32]
    weight: NDArray[np.float32]
    face: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    direction: NDArray[np.float32]
    coverage: NDArray[np.float32]


def face_normals(positions: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Unit normals of the counter-clockwise sides, (F, 3); zero for faces without area."""
    corner = positions[faces]
    n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(n, axis=1, keepdims=True)
    return np.divide(n, length, out=np.zeros_like(n), where=length > 0).astype(np.float32)


def see(
    tracer: Tracer,
    film: Film,
    face_object: NDArray[np.int32],
    face_normals: NDArray[np.float32],
    base_grid: int = BASE_GRID,
    edge_grid: int = EDGE_GRID,
) -> Samples:
    """Traces a camera's samples. face_object (F,), face_normals (F, 3) unit tell where the picture has edges."""
    width, height = film.width, film.height
    base = _shoot(tracer, film, np.arange(width * height, dtype=np.int64), base_grid)
    edges = _edges(base.face, base.distance, face_object, face_normals, width, height, base_grid)
    fine = _shoot(tracer, film, np.flatnonzero(edges), edge_grid)
    keep = ~np.repeat(edges.reshape(-1), base_grid * base_grid)
    parts = [
        (base.pixel[keep], base.face[keep], base.u[keep], base.v[keep], base.direction[keep], base_grid),
        (fine.pixel, fine.face, fine.u, fine.v, fine.direction, edge_grid),
    ]
    pixel = np.concatenate([p[0] for p in parts])
    weight = np.concatenate([np.full(len(p[0]), 1.0 / p[5] ** 2, np.float32) for p in parts])
    face, u, v = (np.concatenate([p[k] for p in parts]) for k in (1, 2, 3))
    direction = np.concatenate([p[4] for p in parts])
    hit = np.flatnonzero(face >= 0)
    hit = hit[np.argsort(pixel[hit], kind="stable")]
    pixel = pixel[hit].astype(np.int32)
    weight = weight[hit]
    coverage = np.bincount(pixel, weights=weight, minlength=width * height).reshape(height, width)
    return Samples(
        pixel,
        weight,
        face[hit],
        u[hit],
        v[hit],
        direction[hit],
        np.minimum(coverage, 1.0).astype(np.float32),
    )


@dataclass(frozen=True)
class _Shots:
    pixel: NDArray[np.int64]
    direction: NDArray[np.float32]
    face: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]


def _shoot(tracer: Tracer, film: Film, pixels: NDArray[np.int64], grid: int) -> _Shots:
    count = len(pixels) * grid * grid
    pixel = np.repeat(pixels, grid * grid)
    direction = np.empty((count, 3), np.float32)
    origin = np.empty((count, 3), np.float32)
    _film_rays(film, pixels, grid, tracer.center, tracer.scale, origin, direction)
    hits = tracer.intersect(origin, direction)
    return _Shots(pixel, direction, hits.face, hits.u, hits.v, hits.distance)


@njit(cache=True, error_model="numpy")
def _film_rays(film, pixels, grid, center, scale, origin, direction):  # type: ignore[no-untyped-def]
    """Rays through a grid of points of every pixel; origins as `camera.approach` has them, in the tracer's frame."""
    eye, n = film.eye, 0
    for pixel in pixels:
        x, y = pixel % film.width, pixel // film.width
        for i in range(grid):
            for j in range(grid):
                d = film_direction(film, x + (j + 0.5) / grid, y + (i + 0.5) / grid)
                ahead = -2.0 / scale
                for k in range(3):
                    ahead += d[k] * (center[k] - eye[k])
                ahead = max(ahead, 0.0)
                for k in range(3):
                    direction[n, k] = d[k]
                    origin[n, k] = (eye[k] + ahead * d[k] - center[k]) * scale
                n += 1


@njit(cache=True)
def _differ(a, b, face, distance, face_object, face_normals):  # type: ignore[no-untyped-def]
    fa, fb = face[a], face[b]
    if fa == fb:
        return False
    if fa < 0 or fb < 0 or face_object[fa] != face_object[fb]:
        return True
    if abs(distance[a] - distance[b]) > 0.05 * min(distance[a], distance[b]):
        return True
    d = (
        face_normals[fa, 0] * face_normals[fb, 0]
        + face_normals[fa, 1] * face_normals[fb, 1]
        + face_normals[fa, 2] * face_normals[fb, 2]
    )
    return d < 0.8


@njit(cache=True)
def _edges(face, distance, face_object, face_normals, width, height, grid):  # type: ignore[no-untyped-def]
    """Pixels whose samples, or the nearest sample of a neighbouring pixel, see something else."""
    area = grid * grid
    out = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            first = (y * width + x) * area
            for k in range(1, area):
                if _differ(first, first + k, face, distance, face_object, face_normals):
                    out[y, x] = True
            if x + 1 < width:
                other = first + area
                if _differ(first + grid - 1, other, face, distance, face_object, face_normals):
                    out[y, x] = True
                    out[y, x + 1] = True
            if y + 1 < height:
                other = first + width * area
                if _differ(first + area - grid, other, face, distance, face_object, face_normals):
                    out[y, x] = True
                    out[y + 1, x] = True
    return out

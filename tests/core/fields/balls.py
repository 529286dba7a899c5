"""Fields of balls in closed form or by rays that are intersected with a ball: nothing is traced."""

import math
from functools import lru_cache

import numpy as np

from relightcli.core.fields.body import clamped_cosine
from relightcli.core.fields.entities import Entity, of_light, of_object
from relightcli.core.fields.field import Field, SourceField, shell_radii
from relightcli.core.fields.proxies import place_proxies, proxy_weights
from relightcli.core.sphere import cube, sh
from relightcli.core.sphere.rotation import rotation_matrices
from tests.core.brdf.reflectances import random_directions

EVEN = math.sqrt(4 * math.pi)
BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def cap(distance, order):
    """Coefficients (..., order) of m = 0 of what a ball of radius 1 covers, seen along +z from a distance >= 1."""
    c = np.sqrt(1 - 1 / np.asarray(distance, float) ** 2)
    p = [np.ones_like(c)] + [np.polynomial.legendre.Legendre.basis(k)(c) for k in range(order + 1)]  # P_-1 = 1
    return np.stack(
        [2 * np.pi * math.sqrt((2 * b + 1) / (4 * np.pi)) * (p[b] - p[b + 2]) / (2 * b + 1) for b in range(order)], -1
    )


def covered(points, order):
    """Coefficients (n, N) of what the ball of radius 1 at the origin covers, seen from points (n, 3) outside."""
    d = np.linalg.norm(points, axis=1)
    bands = cap(d, order) * np.sqrt(4 * np.pi / (2 * np.arange(order) + 1))
    return np.repeat(bands, 2 * np.arange(order) + 1, axis=1) * sh.harmonics(-points / d[:, None], order)


def samples(radii, n):
    return (radii[:, None, None] * cube.texel_directions(n).reshape(1, -1, 3)).reshape(-1, 3)


def bright(order=4, shells=16, n=8, radiance=1.0):
    """Source field of a ball of radius 1."""
    radii = shell_radii(1.0, shells)
    seen = covered(samples(radii, n), order).reshape(shells, -1, order**2, 1) * np.broadcast_to(radiance, 3)
    return SourceField(np.zeros(3), 1.0, radii, n, seen.astype(np.float32))


@lru_cache(maxsize=16)
def ball(albedo=1.0, order=4, shells=6, n=4, proxies=3, rays=16):
    """Field of a Lambert ball of radius 1, occlusion and transfer from the same rays of a cube map of `rays`."""
    radii = shell_radii(1.0, shells)
    directions = cube.texel_directions(rays).reshape(-1, 3)
    weights = np.tile(cube.solid_angles(rays).reshape(-1), 6)
    y = sh.harmonics(directions, order)
    chi = place_proxies(random_directions(400, 1), proxies)
    size = order**2
    points = samples(radii, n)
    occlusion, transfer = np.empty((len(points), size)), np.empty((len(points), len(chi), size, size, 1))
    for k, q in enumerate(points):
        along = directions @ q
        under = along**2 - q @ q + 1
        hit = (under > 0) & (along < 0)
        p = q + directions[hit] * (-along[hit] - np.sqrt(under[hit]))[:, None]
        out = y[hit] * weights[hit, None]
        gives = sh.harmonics(p / np.linalg.norm(p, axis=1, keepdims=True), order) * clamped_cosine(order) / np.pi
        by = proxy_weights(p, chi, 1.0)[:, :, None] * gives[:, None, :] * albedo
        transfer[k, ..., 0] = (out.T @ by.reshape(len(p), -1)).reshape(size, len(chi), size).transpose(1, 0, 2)
        occlusion[k] = EVEN * (np.arange(size) == 0) - out.sum(0)
    shape = shells, 6 * n * n
    return Field(
        np.zeros(3), 1.0, radii, n, np.ones(shape, bool), chi,
        occlusion.reshape(*shape, size).astype(np.float32),
        transfer.reshape(*shape, *transfer.shape[1:]).astype(np.float32),
    )  # fmt: skip


def shadow(shells, n, order=4):
    """Field of a black ball of radius 1 in closed form."""
    radii = shell_radii(1.0, shells)
    passes = EVEN * (np.arange(order**2) == 0) - covered(samples(radii, n), order)
    shape = shells, 6 * n * n
    return Field(
        np.zeros(3), 1.0, radii, n, np.ones(shape, bool), np.zeros((1, 3)),
        passes.reshape(*shape, -1).astype(np.float32), np.zeros((*shape, 1, order**2, order**2, 1), np.float32),
    )  # fmt: skip


def put(field, translation=(0, 0, 0), rotation=None, scale=1.0):
    own = of_light(field) if isinstance(field, SourceField) else of_object(field, BOX)
    return Entity(own, np.eye(3) if rotation is None else rotation, np.asarray(translation, float), scale)


def even_sky(order=4, radiance=1.0):
    out = np.zeros((3, order**2))
    out[:, 0] = EVEN * radiance
    return out


def turned(coefficients, rotation):
    order = math.isqrt(coefficients.shape[-1])
    return coefficients @ rotation_matrices(rotation, order).T

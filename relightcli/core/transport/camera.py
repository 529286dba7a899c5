"""Rays of a pinhole camera with a box filter.

A point (x, y) of the film, in pixels from the top left corner, sees along

    forward + (2x/W - 1) (W/H) tan(fov/2) right + (1 - 2y/H) tan(fov/2) up'

with right = forward x up and up' = right x forward, unit; `fov` is the vertical angle.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import Triple
from relightcli.scene.model import Camera


class Film(NamedTuple):
    """A camera as kernels read it. `corner` (3,) is the direction of film point (0, 0), `step_x` and `step_y` its
    change per pixel to the right and downwards."""

    eye: NDArray[np.float64]
    corner: NDArray[np.float64]
    step_x: NDArray[np.float64]
    step_y: NDArray[np.float64]
    width: int
    height: int


def make_film(camera: Camera) -> Film:
    """The camera's film. `up` must not be parallel to the view (the scene reader checks)."""
    eye = np.array(camera.eye, np.float64)
    forward = np.array(camera.target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.array(camera.up, np.float64))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    width, height = camera.size
    half = math.tan(0.5 * math.radians(camera.fov))
    across = right * (half * width / height)
    down = -up * half
    return Film(eye, forward - across - down, across * (2.0 / width), down * (2.0 / height), width, height)


@njit(cache=True, error_model="numpy")
def film_direction(film: Film, x: float, y: float) -> Triple:
    """Unit direction seen through the film point (x, y), in pixels."""
    a = film.corner[0] + x * film.step_x[0] + y * film.step_y[0]
    b = film.corner[1] + x * film.step_x[1] + y * film.step_y[1]
    c = film.corner[2] + x * film.step_x[2] + y * film.step_y[2]
    length = math.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length


def film_directions(film: Film, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Unit directions through film points; x and y broadcast to (...), the result is (..., 3)."""
    d = film.corner + x[..., None] * film.step_x + y[..., None] * film.step_y
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def approach(eye: NDArray[np.float64], directions: NDArray[Any], center: Any, scale: float) -> NDArray[np.float64]:
    """Ray origins (N, 3): the eye, moved along each ray to just outside the sphere that holds the scene.

    The tracer's frame puts the scene into [-1, 1]^3 by `(x - center) * scale`; from an eye far outside, float32
    origins would be coarser than a pixel.
    """
    ahead = directions @ (np.asarray(center) - eye) - 2.0 / scale
    return eye + np.maximum(ahead, 0.0)[:, None] * directions

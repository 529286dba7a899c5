"""Animation clips of a node hierarchy: key frames, glTF's three interpolations, quaternions.

Quaternions are (x, y, z, w), unit, as glTF writes them; q and -q are one rotation.
Source: Khronos glTF 2.0 specification, section 3.11 and appendix C, named [glTF, ...] below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
PathName = Literal["translation", "rotation", "scale"]
Interpolation = Literal["STEP", "LINEAR", "CUBICSPLINE"]


@dataclass(frozen=True, eq=False)
class Channel:
    """One property of one node over time.

    node: index into the rig's nodes; times (K,) float64 seconds, rising, K >= 1; values (K, W) float64, W = 4 for
    rotations (unit quaternions) and 3 else; for CUBICSPLINE (K, 3, W): incoming tangent, value, outgoing tangent.
    """

    node: int
    path: PathName
    interpolation: Interpolation
    times: F64
    values: F64


@dataclass(frozen=True, eq=False)
class Clip:
    """A named motion. `start` and `stop`: the first and the last key of any channel, seconds."""

    name: str
    channels: tuple[Channel, ...]

    @property
    def start(self) -> float:
        return min((float(c.times[0]) for c in self.channels), default=0.0)

    @property
    def stop(self) -> float:
        return max((float(c.times[-1]) for c in self.channels), default=0.0)

    @property
    def seconds(self) -> float:
        """From the first key to the last; 0 for a clip of one frame."""
        return self.stop - self.start

    def frames(self) -> F64:
        """The times of all keys, each once, rising: the frames that the clip was made of. At least one."""
        times = [c.times for c in self.channels]
        return np.unique(np.concatenate(times)) if times else np.zeros(1)


@dataclass(frozen=True, eq=False)
class Track:
    """Channels of one path that have their times and their interpolation in common.

    nodes (C,); times (K,); values (K, C, W), for CUBICSPLINE (K, 3, C, W).
    """

    path: PathName
    interpolation: Interpolation
    nodes: NDArray[np.int64]
    times: F64
    values: F64


@lru_cache(maxsize=256)
def tracks(clip: Clip) -> tuple[Track, ...]:
    """The clip's channels, put together: exporters and motion capture give many the same times."""
    groups: dict[tuple[str, str, bytes], list[Channel]] = {}
    for channel in clip.channels:
        groups.setdefault((channel.path, channel.interpolation, channel.times.tobytes()), []).append(channel)
    return tuple(
        Track(
            group[0].path,
            group[0].interpolation,
            np.array([c.node for c in group]),
            group[0].times,
            np.stack([c.values for c in group], axis=-2),
        )
        for group in groups.values()
    )


def sample(track: Channel | Track, seconds: F64) -> F64:
    """Values (M, W) of a channel, (M, C, W) of a track, at times (M,); outside the keys, those of the first or last.

    STEP holds the last key. LINEAR mixes two keys, rotations along the shorter arc (slerp). CUBICSPLINE is Hermite's
    spline through the keys; rotations are then scaled to unit length [glTF, C.3 to C.5].
    """
    times, values = track.times, track.values
    spline = track.interpolation == "CUBICSPLINE"
    t = np.clip(np.asarray(seconds, np.float64), times[0], times[-1])
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
    if track.interpolation == "STEP" or len(times) == 1:
        return np.asarray(values[k, 1] if spline else values[k])
    k = np.minimum(k, len(times) - 2)
    each = (len(t), *[1] * (values.ndim - (2 if spline else 1)))
    span = (times[k + 1] - times[k]).reshape(each)
    u = (t - times[k]).reshape(each) / span
    if track.interpolation == "LINEAR":
        if track.path == "rotation":
            return slerp(values[k], values[k + 1], u)
        return np.asarray((1.0 - u) * values[k] + u * values[k + 1])
    u2, u3 = u * u, u * u * u
    mixed = (
        (2.0 * u3 - 3.0 * u2 + 1.0) * values[k, 1]
        + span * (u3 - 2.0 * u2 + u) * values[k, 2]
        + (3.0 * u2 - 2.0 * u3) * values[k + 1, 1]
        + span * (u3 - u2) * values[k + 1, 0]
    )
    return unit_quaternion(mixed) if track.path == "rotation" else np.asarray(mixed)


def unit_quaternion(q: F64) -> F64:
    """Quaternions (..., 4) at unit length; zero becomes no rotation."""
    length = np.sqrt((q * q).sum(axis=-1, keepdims=True))
    none = np.array([0.0, 0.0, 0.0, 1.0])
    return np.where(length > 0.0, q / np.where(length > 0.0, length, 1.0), none)


def slerp(a: F64, b: F64, u: F64) -> F64:
    """From unit quaternions a (..., 4) to b (..., 4) at u (..., 1) in 0..1, along the shorter arc."""
    dot = (a * b).sum(axis=-1, keepdims=True)
    b = np.where(dot < 0.0, -b, b)
    dot = np.abs(dot)
    # atan2 keeps small angles exact where arccos has half the digits.
    angle = np.arctan2(np.sqrt(((b - dot * a) ** 2).sum(axis=-1, keepdims=True)), dot)
    near = angle < 1e-9
    sine = np.where(near, 1.0, np.sin(angle))
    first = np.where(near, 1.0 - u, np.sin((1.0 - u) * angle) / sine)
    second = np.where(near, u, np.sin(u * angle) / sine)
    return unit_quaternion(first * a + second * b)


def multiply(a: F64, b: F64) -> F64:
    """The rotation b followed by a: products (..., 4) of quaternions (..., 4)."""
    u, v, s, t = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    vector = s * v + t * u + np.cross(u, v)
    return np.concatenate([vector, s * t - (u * v).sum(axis=-1, keepdims=True)], axis=-1)


def conjugate(q: F64) -> F64:
    """The opposite rotations of unit quaternions (..., 4)."""
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def rotation_matrix(q: F64) -> F64:
    """Matrices (..., 3, 3) of unit quaternions (..., 4) [glTF, 3.5.3]."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(matrix: F64) -> F64:
    """Unit quaternions (..., 4) of rotation matrices (..., 3, 3), with w >= 0."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(flat, np.float64).reshape(*matrix.shape[:-2], 4)


def rotation_vector(q: F64) -> F64:
    """The logarithm (..., 3) of unit quaternions (..., 4): axis times angle, angle from 0 to pi, radians."""
    q = np.where(q[..., 3:] < 0.0, -q, q)
    sine = np.sqrt((q[..., :3] ** 2).sum(axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    return np.asarray(q[..., :3] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0))


def nearest_turn(vectors: F64, references: F64) -> F64:
    """Rotation vectors (..., 3), each moved by whole turns about its own axis to be nearest to its reference."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    along = np.where(length > 1e-12, vectors, references)  # at no rotation every axis is as good
    size = np.sqrt((along * along).sum(axis=-1, keepdims=True))
    axis = along / np.where(size > 1e-12, size, 1.0)
    turns = np.rint(((references - vectors) * axis).sum(axis=-1, keepdims=True) / (2.0 * np.pi))
    return np.asarray(vectors + 2.0 * np.pi * turns * axis)


@njit(cache=True)
def unwrap_vectors(vectors):  # type: ignore[no-untyped-def]
    """Rotation vectors (M, 3) of a motion, each moved by whole turns to be nearest to the one before.

    The result is continuous in time where the motion is, unless it leaves a full turn away from rest about another
    axis than it came there by: no rotation vectors are, there.
    """
    out = vectors.copy()
    axis = np.empty(3)
    for i in range(1, len(out)):
        size = np.sqrt((vectors[i] * vectors[i]).sum())
        axis[:] = vectors[i] if size > 1e-12 else out[i - 1]
        size = np.sqrt((axis * axis).sum())
        if size > 1e-12:
            axis /= size
            turns = np.rint(((out[i - 1] - vectors[i]) * axis).sum() / (2.0 * np.pi))
            out[i] += 2.0 * np.pi * turns * axis
    return out

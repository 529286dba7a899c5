"""A skinned character: node hierarchy, skin, clips; its poses, as matrices and as numbers to regress on.

Matrices are row-major for column vectors. Linear blend skinning as glTF defines it: vertex v of a pose lies at

    p_v = sum_w weight[v, w] G[joint_node[joint[v, w]]] inverse_bind[joint[v, w]] position[v]

with G the nodes' world matrices; the node that carries the mesh has no say [glTF 2.0, 3.7.3.3].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.pose.clip import (
    Channel,
    Clip,
    Track,
    conjugate,
    multiply,
    nearest_turn,
    rotation_matrix,
    rotation_vector,
    sample,
    tracks,
    unwrap_vectors,
)

F64 = NDArray[np.float64]
# A property that no clip changes by more than this (radians; share of the character's size; factor) stands still.
STILL = 1e-4
# Steps between two keys in which a rotation is followed; slerp turns by less than pi between them.
STEPS = 8


@dataclass(frozen=True, eq=False)
class Rig:
    """V vertices in bind space, with up to W joints each; J joints; N nodes, every parent before its children.

    position (V, 3) float64; normal, tangent (V, 3) float64, unit and orthogonal: the x and z axes of a vertex's frame,
    y = normal x tangent; joint (V, W) int32; weight (V, W) float64, of sum 1; inverse_bind (J, 4, 4) float64;
    parent (N,) int32, -1 for roots; rest (N, 4, 4) float64, local matrices; translation (N, 3), rotation (N, 4),
    scale (N, 3) float64: what `rest` is made of where a clip may move the node; joint_node (J,) int32; node_names (N).
    """

    position: F64
    normal: F64
    tangent: F64
    joint: NDArray[np.int32]
    weight: F64
    inverse_bind: F64
    parent: NDArray[np.int32]
    rest: F64
    translation: F64
    rotation: F64
    scale: F64
    joint_node: NDArray[np.int32]
    node_names: tuple[str, ...]
    clips: tuple[Clip, ...] = ()

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.node_names[n] for n in self.joint_node)


@dataclass(frozen=True)
class _Feature:
    """One property of one node that counts; `start` is its first number's place among the features."""

    node: int
    path: str
    start: int


def node_matrices(rig: Rig, clip: Clip | None, seconds: float) -> F64:
    """World matrices (N, 4, 4) of all nodes at a time of a clip, clamped to its ends; None is the rest pose."""
    local = rig.rest.copy()
    if clip is not None:
        local = _animated(rig, clip, seconds, local)
    world = np.empty_like(local)
    for n, parent in enumerate(rig.parent):
        world[n] = local[n] if parent < 0 else world[parent] @ local[n]
    return world


def joint_matrices(rig: Rig, clip: Clip | None, seconds: float = 0.0) -> F64:
    """Matrices (J, 4, 4) from bind space to the pose at a time of a clip, seconds, clamped to the clip's ends.

    clip None: the rest pose, in which the file's nodes stand. Source: [glTF 2.0, 3.7.3.3].
    """
    return np.asarray(node_matrices(rig, clip, seconds)[rig.joint_node] @ rig.inverse_bind)


def _animated(rig: Rig, clip: Clip, seconds: float, local: F64) -> F64:
    moved = sorted({c.node for c in clip.channels})
    state = {"translation": rig.translation.copy(), "rotation": rig.rotation.copy(), "scale": rig.scale.copy()}
    for track in tracks(clip):
        state[track.path][track.nodes] = sample(track, np.array([seconds]))[0]
    local[moved] = 0.0
    local[moved, :3, :3] = rotation_matrix(state["rotation"][moved]) * state["scale"][moved][:, None, :]
    local[moved, :3, 3] = state["translation"][moved]
    local[moved, 3, 3] = 1.0
    return local


def skin(rig: Rig, matrices: F64) -> tuple[F64, F64, F64]:
    """Positions, normals and tangents (V, 3) float64 of a pose, by linear blend skinning.

    matrices (J, 4, 4), from `joint_matrices`, or those with one more matrix before them all. Normals go by the inverse
    transpose of the blended matrix, so they stay right under scales that differ by axis; tangents by the matrix itself,
    made orthogonal to the normal again. Where the blend is singular and leaves no direction, the frame is any one.
    """
    position, normal, tangent = blend(
        rig.position, rig.normal, rig.tangent, rig.joint, rig.weight, np.ascontiguousarray(matrices)
    )
    return position, normal, tangent


def posed(rig: Rig, transform: F64, clip: Clip | None, seconds: float = 0.0) -> tuple[F64, F64, F64]:
    """`skin` of a pose, (V, 3) each, in the space that `transform` (4, 4) takes the rig's to: an object's place."""
    return skin(rig, transform @ joint_matrices(rig, clip, seconds))


@njit(cache=True)
def blend(position, normal, tangent, joint, weight, matrices):  # type: ignore[no-untyped-def]
    """`skin` of a rig's arrays of those names."""
    count = len(position)
    out_p, out_n, out_t = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 3))
    m = np.empty((3, 4))
    c = np.empty((3, 3))
    for v in range(count):
        m[:] = 0.0
        for w in range(joint.shape[1]):
            if weight[v, w] != 0.0:
                for i in range(3):
                    for k in range(4):
                        m[i, k] += weight[v, w] * matrices[joint[v, w], i, k]
        largest = 0.0
        for i in range(3):
            out_p[v, i] = m[i, 0] * position[v, 0] + m[i, 1] * position[v, 1] + m[i, 2] * position[v, 2] + m[i, 3]
            for k in range(3):
                largest = max(largest, abs(m[i, k]))
        if largest > 0.0:  # so that cofactors neither overflow nor vanish
            for i in range(3):
                for k in range(3):
                    m[i, k] /= largest
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for k in range(3):
                x, y = (k + 1) % 3, (k + 2) % 3
                c[i, k] = m[a, x] * m[b, y] - m[a, y] * m[b, x]
        # (M^-1)^T = C / det M
        mirror = m[0, 0] * c[0, 0] + m[0, 1] * c[0, 1] + m[0, 2] * c[0, 2] < 0.0
        for i in range(3):
            n = c[i, 0] * normal[v, 0] + c[i, 1] * normal[v, 1] + c[i, 2] * normal[v, 2]
            out_n[v, i] = -n if mirror else n
            out_t[v, i] = m[i, 0] * tangent[v, 0] + m[i, 1] * tangent[v, 1] + m[i, 2] * tangent[v, 2]
        if not _normalise(out_n[v]):
            out_n[v] = normal[v]
        along = out_n[v, 0] * out_t[v, 0] + out_n[v, 1] * out_t[v, 1] + out_n[v, 2] * out_t[v, 2]
        for i in range(3):
            out_t[v, i] -= along * out_n[v, i]
        if not _normalise(out_t[v]):
            axis = 0
            for i in range(1, 3):
                if abs(out_n[v, i]) < abs(out_n[v, axis]):
                    axis = i
            for i in range(3):
                out_t[v, i] = (1.0 if i == axis else 0.0) - out_n[v, axis] * out_n[v, i]
            _normalise(out_t[v])
    return out_p, out_n, out_t


@njit(cache=True)
def _normalise(vector):  # type: ignore[no-untyped-def]
    length = np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if not length > 1e-150:
        return False
    for i in range(3):
        vector[i] /= length
    return True


def any_tangents(normals: F64) -> F64:
    """Unit vectors (V, 3) orthogonal to unit normals (V, 3); smooth but for a seam at z = 0 [Duff et al. 2017]."""
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.stack([1.0 + sign * x * x * a, sign * x * y * a, -sign * x], axis=1)


def pose_features(rig: Rig, clip: Clip | None, seconds: float = 0.0) -> F64:
    """The pose as numbers (j,) float64 for a linear model to regress on; `feature_names` says which is which.

    Of every node that moves a part of the skin and not all of it, and that the clips move: the rotation relative to
    rest, rest^-1 q, as axis times angle (3 numbers, radians); where a clip moves them, also its translation relative to
    rest, over the diagonal of the character's box (3 numbers), and its scale less that at rest (3 numbers). What
    turns, moves or scales the whole character does not count: nothing of it changes what a vertex sees of its own
    body. Along a clip the numbers are continuous, beyond half a turn too (`clip.unwrap_vectors`); at the start of every
    clip angles are at most pi. clip None: the rest pose, all 0.
    """
    if clip is None:
        return np.zeros(_features(rig)[1])
    return clip_features(rig, clip, np.array([seconds]))[0]


def clip_features(rig: Rig, clip: Clip, seconds: F64) -> F64:
    """`pose_features` (M, j) at several times (M,) of one clip."""
    out = np.zeros((len(seconds), _features(rig)[1]))
    for track in _feature_tracks(rig, clip):
        values = sample(track.track, seconds)[:, track.chosen]
        nodes = track.track.nodes[track.chosen]
        if track.track.path == "rotation":
            before = np.searchsorted(track.times, np.minimum(seconds, track.times[-1]), side="right") - 1
            values = nearest_turn(_relative(rig, nodes, values), track.lifted[np.maximum(before, 0)])
        else:
            values = values - getattr(rig, track.track.path)[nodes]
            if track.track.path == "translation":
                values = values / _extent(rig)
        out[:, track.columns] = values
    return out


def feature_names(rig: Rig) -> tuple[str, ...]:
    """What each number of `pose_features` is: NODE.rotation.x, ..."""
    features, _ = _features(rig)
    return tuple(f"{rig.node_names[f.node]}.{f.path}.{axis}" for f in features for axis in "xyz")


@lru_cache(maxsize=16)
def _features(rig: Rig) -> tuple[tuple[_Feature, ...], int]:
    found: list[_Feature] = []
    for node in np.flatnonzero(_partial(rig)):
        for path in ("rotation", "translation", "scale"):
            if _moves(rig, int(node), path):
                found.append(_Feature(int(node), path, 3 * len(found)))
    return tuple(found), 3 * len(found)


def _partial(rig: Rig) -> NDArray[np.bool_]:
    """Nodes (N,) below which, or at which, there are some of the joints that vertices hang on, and not all."""
    used = np.zeros(len(rig.parent), np.int64)
    used[np.unique(rig.joint_node[rig.joint[rig.weight > 0.0]])] = 1
    total = used.sum()
    for n in range(len(used) - 1, -1, -1):
        if rig.parent[n] >= 0:
            used[rig.parent[n]] += used[n]
    return np.asarray((used > 0) & (used < total))


def _moves(rig: Rig, node: int, path: str) -> bool:
    """Whether the clips' frames differ in this property."""
    poses = []
    for clip in rig.clips:
        channel = _channel(clip, node, path)
        rest = getattr(rig, path)[node][None]
        poses.append(rest if channel is None else sample(channel, _followed(channel)))
    if not poses:
        return False
    values = np.concatenate(poses)
    if path == "rotation":
        turned = rotation_vector(multiply(conjugate(values[:1]), values))
        return bool(np.sqrt((turned * turned).sum(axis=1)).max() > STILL)
    limit = STILL * (_extent(rig) if path == "translation" else 1.0)
    return bool(np.abs(values - values[0]).max() > limit)


def _channel(clip: Clip, node: int, path: str) -> Channel | None:
    return next((c for c in clip.channels if c.node == node and c.path == path), None)


def _followed(channel: Channel | Track) -> F64:
    """Times close enough together to follow a rotation through."""
    times = channel.times
    if channel.interpolation == "STEP" or len(times) == 1:
        return times
    u = np.arange(STEPS) / STEPS
    between = times[:-1, None] + u * np.diff(times)[:, None]
    return np.concatenate([between.reshape(-1), times[-1:]])


def _relative(rig: Rig, nodes: NDArray[np.int64], rotations: F64) -> F64:
    """Rotation vectors (M, C, 3) relative to rest of nodes (C,) that are turned by rotations (M, C, 4)."""
    return rotation_vector(multiply(conjugate(rig.rotation[nodes])[None], rotations))


@dataclass(frozen=True)
class _FeatureTrack:
    """What of a track counts: `chosen` of its channels, `columns` (C, 3) among the features; of rotations, times (T,)
    and continuous rotation vectors `lifted` (T, C, 3) relative to rest."""

    track: Track
    chosen: NDArray[np.int64]
    columns: NDArray[np.int64]
    times: F64
    lifted: F64


@lru_cache(maxsize=256)
def _feature_tracks(rig: Rig, clip: Clip) -> tuple[_FeatureTrack, ...]:
    starts = {(f.node, f.path): f.start for f in _features(rig)[0]}
    out = []
    for track in tracks(clip):
        chosen = np.array([i for i, n in enumerate(track.nodes) if (int(n), track.path) in starts], np.int64)
        if not len(chosen):
            continue
        first = np.array([starts[int(n), track.path] for n in track.nodes[chosen]])
        times, lifted = np.zeros(0), np.zeros((0, len(chosen), 3))
        if track.path == "rotation":
            times = _followed(track)
            lifted = _relative(rig, track.nodes[chosen], sample(track, times)[:, chosen])
            for column in range(len(chosen)):
                lifted[:, column] = unwrap_vectors(np.ascontiguousarray(lifted[:, column]))
        out.append(_FeatureTrack(track, chosen, first[:, None] + np.arange(3), times, lifted))
    return tuple(out)


def _extent(rig: Rig) -> float:
    diagonal = float(np.linalg.norm(np.ptp(rig.position, axis=0))) if len(rig.position) else 0.0
    return diagonal or 1.0

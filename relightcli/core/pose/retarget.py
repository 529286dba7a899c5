"""Motion of one skeleton put onto another: captured joints' turns in the world, onto the joints of a rig.

With G_b(t) the world rotation of captured joint b (the identity at its rest), W_n that of rig node n at rest and A_n
the rotation that takes the rig's bones at n to the directions of the captured skeleton's at rest, node n mapped to b
turns in the world as

    R_n(t) = G_b(t) A_n W_n

so that bones point where the captured ones point, whatever pose either skeleton rests in. Nodes that are not mapped
keep their rest rotation relative to their parent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.core.affine import unit
from relightcli.core.pose.clip import (
    Channel,
    Clip,
    conjugate,
    multiply,
    quaternion_of,
    rotation_matrix,
    unit_quaternion,
)
from relightcli.core.pose.rig import Rig, node_matrices

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """B captured joints over F frames: names; parent (B,) int32, -1 for roots, parents first; offset (B, 3) from the
    parent at rest; seconds (F,); rotation (F, B, 4), quaternions, and translation (F, B, 3), relative to the parent."""

    names: tuple[str, ...]
    parent: NDArray[np.int32]
    offset: F64
    seconds: F64
    rotation: F64
    translation: F64


def retarget(rig: Rig, motion: Motion, joints: dict[str, str], name: str) -> Clip:
    """The motion as a clip of the rig. joints: node name to captured joint's name, all of them known.

    The topmost mapped node follows the captured joint's way from its first frame on, scaled by the ratio of the
    skeletons' mapped bones. Scales above mapped nodes must not differ by axis. Rotations are keys of LINEAR channels.
    """
    target = {rig.node_names.index(node): motion.names.index(joint) for node, joint in joints.items()}
    world = node_matrices(rig, None, 0.0)
    rest = _rotations(world)
    captured, way = _world(motion)
    still = _still(motion)
    above = {n: _mapped_above(rig.parent, n, target) for n in target}
    align = _alignments(world[:, :3, 3], still, target, above)

    frames = len(motion.seconds)
    turned: dict[int, F64] = {}  # world rotation (F, 4) of every node
    channels = []
    for n, parent in enumerate(rig.parent):
        base = turned[int(parent)] if parent >= 0 else np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1))
        if n in target:
            turned[n] = multiply(captured[:, target[n]], multiply(align[n], rest[n])[None])
            channels.append(
                Channel(n, "rotation", "LINEAR", motion.seconds, _steady(multiply(conjugate(base), turned[n])))
            )
        else:
            local = rest[n] if parent < 0 else multiply(conjugate(rest[parent]), rest[n])
            turned[n] = multiply(base, local[None])
    top = min(target)
    moved = _scale(world[:, :3, 3], still, target, above) * (way[:, target[top]] - way[0, target[top]])
    inverse = np.linalg.inv(world[rig.parent[top], :3, :3]) if rig.parent[top] >= 0 else np.eye(3)
    translation = rig.translation[top] + moved @ inverse.T
    channels.append(Channel(top, "translation", "LINEAR", motion.seconds, translation))
    return Clip(name, tuple(channels))


def _rotations(world: F64) -> F64:
    """The rotations (N, 4) nearest to matrices (N, 4, 4) without their scales, by the polar decomposition."""
    u, _, v = np.linalg.svd(world[:, :3, :3])
    u[:, :, 2] *= np.sign(np.linalg.det(u @ v))[:, None]
    return quaternion_of(u @ v)


def _world(motion: Motion) -> tuple[F64, F64]:
    """World rotations (F, B, 4) and positions (F, B, 3) of the captured joints."""
    rotation, position = motion.rotation.copy(), motion.translation.copy()
    for b, parent in enumerate(motion.parent):
        if parent >= 0:
            rotation[:, b] = multiply(rotation[:, parent], motion.rotation[:, b])
            turned = rotation_matrix(rotation[:, parent]) @ motion.translation[:, b, :, None]
            position[:, b] = position[:, parent] + turned[..., 0]
    return rotation, position


def _still(motion: Motion) -> F64:
    """Positions (B, 3) of the captured joints at rest."""
    position = motion.offset.copy()
    for b, parent in enumerate(motion.parent):
        if parent >= 0:
            position[b] += position[parent]
    return position


def _mapped_above(parent: NDArray[np.int32], node: int, target: dict[int, int]) -> int:
    """The nearest mapped node above, or -1."""
    node = int(parent[node])
    while node >= 0 and node not in target:
        node = int(parent[node])
    return node


def _alignments(place: F64, still: F64, target: dict[int, int], above: dict[int, int]) -> dict[int, F64]:
    """A_n as quaternions. A joint with one bone turns as little as it can from what it hangs on."""
    out: dict[int, F64] = {}
    for n in sorted(target):
        start = out[above[n]] if above[n] >= 0 else np.array([0.0, 0.0, 0.0, 1.0])
        below = [m for m in target if above[m] == n]
        own = np.array([place[m] - place[n] for m in below]).reshape(-1, 3)
        captured = np.array([still[target[m]] - still[target[n]] for m in below]).reshape(-1, 3)
        lengths = np.linalg.norm(own, axis=1), np.linalg.norm(captured, axis=1)
        good = (lengths[0] > 0.0) & (lengths[1] > 0.0)
        own = own[good] / lengths[0][good, None] @ rotation_matrix(start).T
        captured = captured[good] / lengths[1][good, None]
        out[n] = multiply(_nearest_rotation(own, captured), start)
    return out


def _nearest_rotation(a: F64, b: F64) -> F64:
    """The rotation that takes unit vectors a (K, 3) nearest to b (K, 3); of several, the smallest [Kabsch 1976]."""
    if not len(a):
        return np.array([0.0, 0.0, 0.0, 1.0])
    u, s, v = np.linalg.svd(b.T @ a)
    if s[1] > 0.1 * s[0]:
        u[:, 2] *= np.sign(np.linalg.det(u @ v))
        return quaternion_of(u @ v)
    one, other = unit(np.stack([a.mean(axis=0), b.mean(axis=0)]))
    # Half way between the identity and a half turn lies the turn from one to the other; 1 + cos without cancellation.
    between = one + other
    axis, height = np.cross(one, other), 0.5 * float(between @ between)
    if height < 1e-24:  # opposite: half a turn about any axis across
        axis, height = np.cross(one, np.eye(3)[np.argmin(np.abs(one))]), 0.0
    return unit_quaternion(np.append(axis, height))


def _scale(place: F64, still: F64, target: dict[int, int], above: dict[int, int]) -> float:
    """Length of the rig's mapped bones over that of the captured ones."""
    own = captured = 0.0
    for n, up in above.items():
        if up >= 0:
            own += float(np.linalg.norm(place[n] - place[up]))
            captured += float(np.linalg.norm(still[target[n]] - still[target[up]]))
    return own / captured if captured > 0.0 else 1.0


def _steady(q: F64) -> F64:
    """Quaternions (F, 4) of a motion without changes of sign from one to the next."""
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    out = q.copy()
    out[1:] *= flips[:, None]
    return out

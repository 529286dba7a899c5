"""Points inside the innermost shell of a field, where its samples say too little: rays from there to the object itself.

Each such point becomes a sample of its own behind those of the field: what passes the object, and what it sends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.body import Body, axes
from relightcli.core.fields.chain import EVEN
from relightcli.core.fields.entities import Entity, Lookup
from relightcli.core.fields.sampling import Found, blocked, cone_rays, gather, trace
from relightcli.core.sphere import sh
from relightcli.core.transport.tracer import Tracer

RAYS = 512
COVERED = 0.97  # of the irradiance of even light that an object takes from a point that counts as covered by it


class Close(NamedTuple):
    """target (k,) int64, points that are close to the entity; found and harmonics (H, N) float32, what their rays hit,
    in the entity's frame."""

    target: NDArray[np.int64]
    found: Found
    harmonics: NDArray[np.float32]


def look_close(
    entity: Entity, e: int, body: Body, tracer: Tracer, points: NDArray[np.float64], lookup: Lookup
) -> Close:
    """Rays from the points (n, 3) in the innermost shell of entity number e; tracer over its mesh."""
    target = np.flatnonzero(lookup.inside[:, e])
    own = ((points[target] - entity.translation) @ entity.rotation) / entity.scale
    directions, weight = cone_rays(own, body.center, body.radius, RAYS, 0, 0)
    found = trace(tracer, body, tracer.to_local(own), directions, weight)
    n = body.order**2
    none = np.zeros((0, n), np.float32)
    if not len(target):
        return Close(target, found, none)
    return Close(target, found, sh.harmonics(found.direction.astype(np.float64), body.order).astype(np.float32))


def covered(close: Close, normals: NDArray[np.float32], turn: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the first k close points, with these normals (k, 3) in the world, the object lies on; turn (3, 3)."""
    own = normals.astype(np.float64) @ turn
    count = np.diff(close.found.start)[: len(own)]
    target = np.repeat(np.arange(len(own)), count)
    hits = slice(0, len(target))
    cosine = np.maximum((close.found.direction[hits] * own[target]).sum(axis=1), 0.0) * close.found.weight[target]
    out: NDArray[np.bool_] = np.bincount(target, cosine, len(own)) >= COVERED * math.pi
    return out


def add_samples(
    lookup: Lookup, rows: NDArray[np.float32], closes: list[Close], turns: list[NDArray[np.float64]]
) -> tuple[NDArray[np.float32], list[slice]]:
    """Rows with a sample more for each close point, which from now on reads nothing else of the entity that it is close
    to: `lookup` is changed. Also where the new rows of every entity are.

    closes: those of the first entities; turns, each (N, N), take coefficients to the world's frame.
    """
    more, where, at = [rows], [], len(rows)
    for e, (close, turn) in enumerate(zip(closes, turns, strict=True)):
        count = len(close.target)
        where.append(slice(at, at + count))
        if not count:
            continue
        new = np.zeros((count, *rows.shape[1:]), np.float32)
        new[:, 0] = -blocked(close.found, close.harmonics) @ turn.T
        new[:, 0, 0] += EVEN
        more.append(new)
        lookup.weight[close.target, e] = 0.0
        lookup.weight[close.target, e, 0] = 1.0
        lookup.place[close.target, e, 0] = np.arange(at, at + count)
        at += count
    return np.concatenate(more) if len(more) > 1 else rows, where


def sent(close: Close, body: Body, exits: NDArray[np.float32], turn: NDArray[np.float64]) -> NDArray[np.float32]:
    """Light (k, 3, N) float32 in the world's frame that close points see of diffuse exit radiance (P, 3)."""
    terms = np.zeros((len(exits), body.terms, 3), np.float32)
    terms[:, 0] = exits
    seen = gather(close.found, close.harmonics, terms, body, axes(body.normal))
    out: NDArray[np.float32] = (seen.transpose(0, 2, 1) @ turn.T).astype(np.float32)
    return out

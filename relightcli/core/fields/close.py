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
    own = ((points - entity.translation) @ entity.rotation) / entity.scale
    near = np.linalg.norm(own - entity.own.center, axis=1) < entity.own.grid.radii[0]
    target = np.flatnonzero(near & (lookup.nearest == e).any(axis=1))
    directions, weight = cone_rays(own[target], body.center, body.radius, RAYS, 0, 0)
    found = trace(tracer, body, tracer.to_local(own[target]), directions, weight)
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
    lookup: Lookup,
    rows: NDArray[np.float32],
    close: Close,
    e: int,
    turn: NDArray[np.float64],
) -> tuple[Lookup, NDArray[np.float32], slice]:
    """Lookup and rows with a sample more for each close point, which reads nothing else of entity e; the new rows.

    turn (N, N) takes coefficients to the world's frame.
    """
    new = np.zeros((len(close.target), *rows.shape[1:]), np.float32)
    hidden = blocked(close.found, close.harmonics)
    new[:, 0] = -hidden @ turn.T
    new[:, 0, 0] += EVEN
    place, weight = lookup.place.copy(), lookup.weight.copy()
    weight[close.target, e] = 0.0
    weight[close.target, e, 0] = 1.0
    place[close.target, e, 0] = np.arange(len(rows), len(rows) + len(new))
    where = slice(len(rows), len(rows) + len(new))
    return lookup._replace(place=place, weight=weight), np.concatenate([rows, new]), where


def sent(close: Close, body: Body, exits: NDArray[np.float32], turn: NDArray[np.float64]) -> NDArray[np.float32]:
    """Light (k, 3, N) float32 in the world's frame that close points see of diffuse exit radiance (P, 3)."""
    terms = np.zeros((len(exits), body.terms, 3), np.float32)
    terms[:, 0] = exits
    seen = gather(close.found, close.harmonics, terms, body, axes(body.normal))
    out: NDArray[np.float32] = (seen.transpose(0, 2, 1) @ turn.T).astype(np.float32)
    return out

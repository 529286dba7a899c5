"""The suns of a sky apart from the rest of it: who sees them, past what stands and what moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from relightcli.adapters.rays import Tracer
from relightcli.core.fields.entities import Entity
from relightcli.core.fields.suns import may_meet
from relightcli.core.lights.points import Points, split_points
from relightcli.stages.placed import Mover
from relightcli.stages.placement import ball

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Suns:
    """rest: the sky without its suns; points: these; rays: how many the last `seen` has traced.

    What stands is traced once for every sun, from what stands itself; movers for every place, from where a ray may
    meet them.
    """

    def __init__(self, still: Tracer, position: F64, normal: F32) -> None:
        """still over what stands; position, normal (n, 3) of the standing receivers."""
        self.rays = 0
        self._still, self._position, self._normal = still, position, normal
        self._given: tuple[F32, float] | None = None
        self._past: NDArray[np.bool_] | None = None

    def set_sky(self, environment: F32, rotate: float) -> None:
        """Takes the suns out of a sky; nothing is done for the same array again."""
        if self._given is not None and self._given[0] is environment and self._given[1] == rotate:
            return
        self.rest: F32
        self.points: Points
        self.rest, self.points, _ = split_points(environment, rotate)
        self._given, self._past = (environment, rotate), None

    def seen(
        self, movers: list[Mover], entities: list[Entity], position: F64, normal: F32, threads: int
    ) -> NDArray[np.bool_]:
        """Who sees which sun (N, K); position, normal of all receivers, the standing ones first."""
        self.rays = 0
        d, static = self.points.direction, len(self._position)
        if self._past is None:
            self._past = self._clear(self._position, self._normal, self._facing(self._normal))
        moving = self._clear(position[static:], normal[static:], self._facing(normal[static:]))
        seen = np.concatenate([self._past, moving])
        for mover, entity in zip(movers, entities, strict=False):
            row, which = np.nonzero(may_meet(position, d, *ball(entity), seen, threads))
            own = ((position[row] - entity.translation) @ entity.rotation) / entity.scale
            origins = mover.tracer.offset(own, normal[row] @ entity.rotation)
            there = np.ascontiguousarray((d @ entity.rotation)[which], np.float32)
            seen[row, which] = ~mover.tracer.occluded(origins, there)
            self.rays += len(row)
        return seen

    def _facing(self, normal: F32) -> NDArray[np.bool_]:
        out: NDArray[np.bool_] = normal.astype(np.float64) @ self.points.direction.T > 0.0
        return out

    def _clear(self, position: F64, normal: F32, open_: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Those of the open rays that what stands does not block."""
        row, which = np.nonzero(open_)
        if len(row) and not self._still.empty:
            directions = self.points.direction.astype(np.float32)[which]
            open_[row, which] = ~self._still.occluded(self._still.offset(position, normal)[row], directions)
            self.rays += len(row)
        return open_

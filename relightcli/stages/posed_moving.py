"""A pose store with fields: characters in any pose beside rigid objects and local lights anywhere.

Characters stand, as far as fields go: movers see them where they are posed, through the rays of their sites, and take
their light; what movers hide of the sky, and send, comes to a character's vertices as to all else that stands
(`moving`). What characters and the rest do to each other is as without movers (`pose_scene`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.lights.environment import SkyCube
from relightcli.core.transport.local_lights import pack_lights
from relightcli.stages.moving import MovingStore
from relightcli.stages.placement import Sites
from relightcli.stages.posed import PoseStore


class PosedMovingStore(MovingStore, PoseStore):
    """An open pose store with fields, with the interface of `LightingStore`."""

    def __init__(self, store: Path | formats.Store, threads: int) -> None:
        super().__init__(store, threads)
        self._apart = frozenset(self.geometry.object_names.index(mover.name) for mover in self.movers)
        self._asked: tuple[tuple[str, ...], tuple[str, ...]] = (), ()

    def set_moves(self, moves: tuple[str, ...]) -> list[str]:
        """See `MovingStore.set_moves`; poses stay."""
        self._asked = moves, self._asked[1]
        notes = super().set_moves(moves)
        self._pose_again()
        return notes

    def set_poses(self, poses: tuple[str, ...]) -> list[str]:
        """See `PoseStore.set_poses`; places stay."""
        self._asked = self._asked[0], poses
        super().set_moves(self._asked[0])
        return self._pose_again()

    def _pose_again(self) -> list[str]:
        notes = self._pose(self._asked[1], self.geometry, self.position, self.normal)
        # What hangs on where characters are, and is kept from move to move.
        self._standing = self.geometry.positions
        self._still, self._sites = Tracer(self._standing, self._faces, self.threads), Sites(self.movers)
        self._bits_of_lights, self._terms, self._undimmed = {}, None, None
        self._placed = self._cosines = None
        if self._suns is not None:
            self.trace_suns()
        return notes

    def _sky_terms(self, sky: SkyCube) -> NDArray[np.float32]:
        if self._scene is not None:
            self._scene.look_around()  # what movers hide from posed receivers is taken from bits
        return super()._sky_terms(sky)

    def _past_what_stands(self) -> NDArray[np.uint8]:
        found = super()._past_what_stands()
        if self._scene is None:
            return found
        now = list(self._now.lights.values())
        return self._scene.light_bits(found, pack_lights(now), now)

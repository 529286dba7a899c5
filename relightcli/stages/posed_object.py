"""One skinned object of a pose store: its model of visibility, and where it is at a moment of a clip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.core.pose.clip import Clip
from relightcli.core.pose.linear_model import distance
from relightcli.core.pose.rig import Rig, pose_features, posed
from relightcli.core.pose.shading import Synthesis, part_of, synthesis
from relightcli.errors import StoreError
from relightcli.stages.lighting import LightingStore

F32 = NDArray[np.float32]
TURNED = np.array([[1.0], [-1.0], [-1.0]], np.float32)  # a front's frame to its back's: half a turn about the tangent


@dataclass(frozen=True)
class Side:
    """The fronts, or the backs, of an object's vertices: the model of what all of them see; `vertices` (N,) of the rig
    that are lit there, and their receivers (N,)."""

    back: bool
    model: Synthesis
    vertices: NDArray[np.int64]
    receivers: NDArray[np.int32]


class PosedObject:
    """One skinned object: its sides, which receivers are its vertices', and what its poses are told from."""

    def __init__(self, store: LightingStore, number: str, about: dict[str, Any], rig: Rig) -> None:
        read: Any = store.store.read
        group = f"pose/{number}"
        self.name, self.weight, self.gap = str(about["object"]), str(about["weight"]), float(about["gap"])
        self.rig, self.transform = rig, store.scene.objects[self.name].transform
        self.features: NDArray[np.float64] = read(f"{group}/features")
        self.mean: NDArray[np.float64] = read(f"{group}/model/pose_mean")
        self.directions: NDArray[np.float64] = read(f"{group}/model/pose_direction")
        model = synthesis(
            read(f"{group}/model/intercept"),
            read(f"{group}/model/slope_scale")[:, :, 0],
            read(f"{group}/model/slope"),
            read(f"{group}/model/centre"),
            str(about["axes"]),
            int(about["order"]),
        )
        self.vertices = np.flatnonzero(store.geometry.vertex_object == int(number))
        count, places = len(rig.position), [r[self.vertices] for r in store.receiver_of_vertex()]
        sides = 2 if (places[1] >= 0).any() else 1
        if about["sides"] != sides or any(len(array) != sides * count for array in model[:4]):
            raise StoreError(
                f"{store.store.path}: {group}/model: expected {sides} x {count} rows, for every lit side of every "
                f"vertex of {self.name!r}, found {len(model.intercept)}. Precompute and fit it again."
            )
        self.order = model.order
        self.sides: list[Side] = []
        for side, receivers in enumerate(places[:sides]):
            rows = slice(side * count, (side + 1) * count)
            lit = np.flatnonzero(receivers >= 0)
            self.sides.append(Side(bool(side), part_of(model, rows), lit, receivers[lit]))
        self.receivers = np.concatenate([side.receivers for side in self.sides])

    def at(self, clip: Clip, seconds: float) -> PosedState:
        """Where the object is at that moment of a clip."""
        position, normal, tangent = posed(self.rig, self.transform, clip, seconds)
        frames = np.stack([tangent, np.cross(normal, tangent), normal], 1).astype(np.float32)
        features = pose_features(self.rig, clip, seconds)
        scores = (features - self.mean) @ self.directions
        return PosedState(position, normal, frames, scores, distance(self.features, features))


@dataclass(frozen=True)
class PosedState:
    """position, normal (V, 3) float64 and frames (V, 3, 3) float32 in the world; scores (K,); distance from the
    training frames (`linear_model.distance`)."""

    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    frames: F32
    scores: NDArray[np.float64]
    distance: float

    def facing(self, side: Side) -> tuple[NDArray[np.float64], F32]:
        """Normals (V, 3) and frames (V, 3, 3) of one side of the skin."""
        return (-self.normal, self.frames * TURNED) if side.back else (self.normal, self.frames)

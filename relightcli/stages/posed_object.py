"""One skinned object of a pose store: its model of visibility, and where it is at a moment of a clip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.core.pose.clip import Clip
from relightcli.core.pose.linear_model import distance
from relightcli.core.pose.rig import Rig, pose_features, posed
from relightcli.core.pose.shading import Synthesis, synthesis
from relightcli.stages.lighting import LightingStore

F32 = NDArray[np.float32]


class PosedObject:
    """One skinned object: its model, which receivers are its vertices', and the pose it is in."""

    def __init__(self, store: LightingStore, number: str, about: dict[str, Any], rig: Rig) -> None:
        read: Any = store.store.read
        group = f"pose/{number}"
        self.name, self.weight, self.gap = str(about["object"]), str(about["weight"]), float(about["gap"])
        self.rig, self.transform = rig, store.scene.objects[self.name].transform
        self.features: NDArray[np.float64] = read(f"{group}/features")
        self.mean: NDArray[np.float64] = read(f"{group}/model/pose_mean")
        self.directions: NDArray[np.float64] = read(f"{group}/model/pose_direction")
        self.model: Synthesis = synthesis(
            read(f"{group}/model/intercept"),
            read(f"{group}/model/slope_scale")[:, :, 0],
            read(f"{group}/model/slope"),
            read(f"{group}/model/centre"),
            str(about["axes"]),
            int(about["order"]),
        )
        self.vertices = np.flatnonzero(store.geometry.vertex_object == int(number))
        front, back = store.receiver_of_vertex()
        front, back = front[self.vertices], back[self.vertices]
        self.front = np.flatnonzero(front >= 0)  # vertices of the rig, and their receivers
        self.front_receiver = front[self.front]
        self.back = np.flatnonzero(back >= 0)
        self.back_receiver = back[self.back]

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

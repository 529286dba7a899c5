"""Which moments of a character's clips to learn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.core.pose.rig import Rig, clip_features

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Frames:
    """F moments: clip (F,) int32 into the rig's clips, seconds (F,) and features (F, j) float64; by clip, then time."""

    clip: NDArray[np.int32]
    seconds: F64
    features: F64

    def __len__(self) -> int:
        return len(self.clip)

    def take(self, index: NDArray[np.intp]) -> Frames:
        return Frames(self.clip[index], self.seconds[index], self.features[index])


def all_frames(rig: Rig) -> Frames:
    """Every key frame of every clip."""
    times = [clip.frames() for clip in rig.clips]
    features = [clip_features(rig, clip, t) for clip, t in zip(rig.clips, times, strict=True)]
    return Frames(
        np.repeat(np.arange(len(times), dtype=np.int32), [len(t) for t in times]),
        np.concatenate(times),
        np.concatenate(features),
    )


def every(frames: Frames, step: int) -> Frames:
    """Every `step`-th frame of every clip, from its first on."""
    starts = np.searchsorted(frames.clip, frames.clip)
    return frames.take(np.flatnonzero((np.arange(len(frames)) - starts) % step == 0))


def spread(frames: Frames, count: int) -> Frames:
    """At most `count` frames far apart: from the one nearest to the mean on, always the one farthest from all before.

    Distance is Euclidean in the features. Frames with the features of one that is taken already are never taken.
    Source: [Gonzalez 1985], whose largest distance to a taken frame is at most twice the least possible.
    """
    if len(frames) <= count:
        return frames
    features = frames.features
    away = ((features - features.mean(axis=0)) ** 2).sum(axis=1)
    taken = [int(np.argmin(away))]
    nearest = ((features - features[taken[0]]) ** 2).sum(axis=1)
    while len(taken) < count and nearest.max() > 0.0:
        taken.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((features - features[taken[-1]]) ** 2).sum(axis=1))
    return frames.take(np.sort(np.array(taken)))

"""A linear model of many numbers as functions of a pose: y = intercept + slope . scores(pose).

Features of poses are collinear, constant, or more than there are frames: they are first turned into a few scores, the
principal components of the training poses, cut where singular values fall below a share of the largest. The paper
solves A X = B without a constant column, which predicts no visibility for the zero pose; here it has one.

A ridge in the features' own units,

    sum over frames of w (b - x_0 - t . x)^2 + ridge s_1^2 |beta|^2,    beta the slope by features,

weighs on the components that the training poses hardly show, and thus on where a new pose is least like them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts

CUT = 1e-8  # of the largest singular value
COMPONENTS = 20  # at most, unless asked for more: ten thousand vertices take 5 MB
SEGMENTS = 6


class PoseSpace(NamedTuple):
    """Scores (K,) of features (j,): (features - mean) @ directions, of unit variance over the training frames.

    mean (j,), directions (j, K), share (K,): variance as a share of the first's, all float64; rank: of the features.
    """

    mean: NDArray[np.float64]
    directions: NDArray[np.float64]
    share: NDArray[np.float64]
    rank: int

    def scores(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., j) to (..., K)."""
        out: NDArray[np.float64] = (features - self.mean) @ self.directions
        return out


def pose_space(features: NDArray[np.float64], most: int = COMPONENTS) -> PoseSpace:
    """The space of training features (F, j), at most `most` components.

    Raises ValueError without a frame, or for features that are not finite.
    """
    frames, count = features.shape
    if frames == 0 or not np.isfinite(features).all():
        raise ValueError("features: expected at least one frame of finite numbers")
    mean = features.mean(0)
    centred = features - mean
    _, singular, rows = np.linalg.svd(centred, full_matrices=False)
    # A lone frame, or frames that are all alike, leave rounding: it is no direction.
    floor = max(CUT * singular.max(initial=0.0), 1e-12 * np.abs(features).max(initial=0.0) * np.sqrt(frames))
    rank = int(np.count_nonzero(singular > floor))
    kept = min(rank, most)
    rows, singular = rows[:kept], singular[:kept]
    sign = np.sign(rows[np.arange(kept), np.abs(rows).argmax(1)]) if kept else np.empty(0)
    directions = (rows * sign[:, None]).T * (np.sqrt(frames) / singular) if kept else np.zeros((count, 0))
    share = (singular / singular[0]) ** 2 if kept else np.zeros(0)
    return PoseSpace(mean, directions, share, rank)


class Linear(NamedTuple):
    """intercept (V, P) and slope (V, P, K), float64."""

    intercept: NDArray[np.float64]
    slope: NDArray[np.float64]


def regress(
    scores: NDArray[np.float64],
    share: NDArray[np.float64],
    targets: NDArray[np.float32],
    ridge: float,
    weights: NDArray[np.float32] | None = None,
    weight_of: NDArray[np.int64] | None = None,
    threads: int = 1,
) -> Linear:
    """The least-squares model of targets (F, V, P) from scores (F, K).

    weights (F, V, Q) and weight_of (P,): which of them a target has, -1 for none. The sums run in a fixed order for
    every vertex, so that the result does not depend on `threads`.
    """
    frames, vertices, count = targets.shape
    design = np.concatenate([np.ones((frames, 1)), scores], 1)
    # The components' own share of ridge; a breath of it keeps the system of few frames solvable.
    penalty = np.concatenate([[0.0], ridge / np.maximum(share, 1e-300) + 1e-12])
    if weights is None:
        weights = np.ones((frames, vertices, 1), np.float32)
    if weight_of is None:
        weight_of = np.full(count, -1, np.int64)
    out = np.empty((vertices, count, design.shape[1]))

    def part(a: int, b: int) -> None:
        _regress(design, penalty, targets, weights, weight_of, a, b, out)

    in_parts(part, vertices, threads)
    return Linear(out[..., 0].copy(), out[..., 1:].copy())


@njit(cache=True, nogil=True, error_model="numpy")
def _regress(design, penalty, targets, weights, weight_of, first, last, out):  # type: ignore[no-untyped-def]
    frames, size = design.shape
    even = np.empty((size, size))
    _normal(design, np.ones(frames), penalty, even)
    own = np.empty((weights.shape[2], size, size))
    w, row = np.empty((weights.shape[2], frames)), np.empty(size)
    weighted = (weight_of >= 0).any()
    for v in range(first, last):
        for q in range(weights.shape[2] if weighted else 0):
            total = 0.0
            for t in range(frames):
                w[q, t] = weights[t, v, q]
                total += w[q, t]
            for t in range(frames):
                w[q, t] = w[q, t] / total if total > 0.0 else 1.0 / frames
            _normal(design, w[q], penalty, own[q])
        for p in range(targets.shape[2]):
            q = weight_of[p]
            row[:] = 0.0
            for t in range(frames):
                b = targets[t, v, p] * (w[q, t] if q >= 0 else 1.0 / frames)
                for k in range(size):
                    row[k] += design[t, k] * b
            factor = own[q] if q >= 0 else even
            for i in range(size):
                total = row[i]
                for k in range(i):
                    total -= factor[i, k] * row[k]
                row[i] = total / factor[i, i]
            for i in range(size - 1, -1, -1):
                total = row[i]
                for k in range(i + 1, size):
                    total -= factor[k, i] * row[k]
                row[i] = total / factor[i, i]
            out[v, p] = row


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(design, w, penalty, out):  # type: ignore[no-untyped-def]
    """Cholesky factor, lower, of the normal equations for weights w (F,) scaled to sum 1."""
    frames, size = design.shape
    out[:] = 0.0
    total = w.sum()
    for t in range(frames):
        for i in range(size):
            a = design[t, i] * w[t] / total
            for j in range(i + 1):
                out[i, j] += a * design[t, j]
    for i in range(size):
        out[i, i] += penalty[i]
    for i in range(size):
        for j in range(i):
            total = out[i, j]
            for k in range(j):
                total -= out[i, k] * out[j, k]
            out[i, j] = total / out[j, j]
        total = out[i, i]
        for k in range(i):
            total -= out[i, k] * out[i, k]
        # A component without weight of its own (frames of no energy) has nothing to say: its slope is nearly 0.
        out[i, i] = np.sqrt(total) if total > 1e-13 else 1e6


def segments(clip: NDArray[np.int32], wanted: int = SEGMENTS) -> NDArray[np.int64]:
    """A segment (F,) for every frame, numbered from 0: runs of one clip, of about a `wanted`-th of all frames."""
    length = max(1, -(-len(clip) // wanted))
    out = np.zeros(len(clip), np.int64)
    segment = -1
    edges = np.flatnonzero(np.diff(clip)) + 1
    for run in np.split(np.arange(len(clip)), edges):
        if len(run) == 0:
            continue
        pieces = max(1, round(len(run) / length))
        for piece in np.array_split(run, pieces):
            segment += 1
            out[piece] = segment
    return out


def gap(features: NDArray[np.float64]) -> float:
    """How far training frames (F, j) lie apart: the largest of their distances to the nearest other one, as
    `distance` measures it; 0 for one frame."""
    if len(features) < 2:
        return 0.0
    return max(distance(np.delete(features, k, 0), row) for k, row in enumerate(features))


def distance(features: NDArray[np.float64], pose: NDArray[np.float64]) -> float:
    """Distance of a pose (j,) from the nearest training frame: the root of the sum of the squared differences."""
    if features.shape[1] == 0:
        return 0.0
    return float(np.sqrt(((features - pose) ** 2).sum(1).min()))

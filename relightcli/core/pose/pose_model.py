"""Models of a vertex's visibility as functions of a pose: lobes, coefficients, coefficients of few components.

    lobes     the numbers of fitted zonal lobes are linear in the pose [Nowrouzezahrai 2008, sec. 3.1]
    sh        every coefficient is linear in the pose
    reduced   so are the weights of the principal components of all vertices' coefficients [Nowrouzezahrai 2007]

All are y = intercept + slope . scores, with a row of numbers y per vertex; they differ in what the numbers mean, and
`reduced` in that scores are those of visibility, predicted from those of the pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.pose.linear_model import (
    COMPONENTS,
    PoseSpace,
    gap,
    pose_space,
    regress,
    segments,
)
from relightcli.core.pose.lobe_parameters import LOG, Parameters, lobes_of, parameters_of
from relightcli.core.pose.phong_operator import phong_matrix
from relightcli.core.pose.zh_lobes import Lobes, fit_lobes, visibility_of

MODELS = ("lobes", "sh", "reduced")
RIDGES = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
SOME = 1000  # vertices at which held-out frames are judged
FEW = 300  # and ridges compared


@dataclass(frozen=True)
class Settings:
    """kind: one of MODELS; lobes: their number; axes: "log" or "angles"; weight: "none", or "cosine" for visibility
    times the cosine, which lambert alone can be lit by; ridge: None for the best of RIDGES at held-out frames;
    components: of poses (`reduced`: of visibility), at most."""

    kind: str = "lobes"
    lobes: int = 2
    axes: str = LOG
    weight: str = "none"
    ridge: float | None = None
    components: int = COMPONENTS


class PoseModel(NamedTuple):
    """mean (j,) and directions (j, K) of the scores; intercept (V, P), slope (V, P, K); centre (V, c, 3), mean axes,
    without lobes (V, 0, 3); order: bands; all float64."""

    mean: NDArray[np.float64]
    directions: NDArray[np.float64]
    intercept: NDArray[np.float64]
    slope: NDArray[np.float64]
    centre: NDArray[np.float64]
    order: int

    def numbers(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """The rows (F, V, P) of poses (F, j)."""
        scores = (features - self.mean) @ self.directions
        return self.intercept + np.einsum("fk,vpk->fvp", scores, self.slope)


def predict(model: PoseModel, features: NDArray[np.float64], axes: str = LOG) -> NDArray[np.float32]:
    """Visibility (F, V, n^2) float32 of poses (F, j), in the vertices' frames."""
    numbers = model.numbers(features).astype(np.float32)
    if model.centre.shape[1] == 0:
        return numbers
    return visibility_of(lobes_of(numbers, model.centre, axes))


@dataclass(frozen=True)
class Errors:
    """Relative RMS errors of visibility. `projection` is that of the training data's own bands against the traced
    visibility, all of its detail; `model` against the same; `bands` of the model against the bands; sd: standard
    deviation of `bands` over frames. A cosine-weighted model is judged against cosine-weighted bands, and has no
    projection."""

    projection: float | None
    model: float | None
    bands: float
    sd: float


@dataclass(frozen=True)
class Report:
    """What a fit found: errors at training frames and, with more than one segment, at held-out ones; `lobes`, the
    error of the lobes themselves, before they are predicted; ridge taken; rank of the features and components kept;
    gap between training poses (see `linear_model.gap`)."""

    training: Errors
    held_out: Errors | None
    lobes: float | None
    ridge: float
    rank: int
    components: int
    segments: int
    gap: float


def cosine_weighted(visibility: NDArray[np.float32]) -> NDArray[np.float32]:
    """Coefficients of V max(0, z) from those of V, (..., n^2), as the bands have it."""
    order = math.isqrt(visibility.shape[-1])
    out: NDArray[np.float32] = np.einsum(
        "...j,ij->...i", visibility, phong_matrix(1.0, order).astype(np.float32)
    )  # M^1 is symmetric
    return out


def fit_model(
    features: NDArray[np.float64],
    visibility: NDArray[np.float32],
    clip: NDArray[np.int32],
    settings: Settings,
    threads: int = 1,
) -> tuple[PoseModel, Report]:
    """The model of visibility (F, V, n^2) in the vertices' frames as a function of features (F, j), and its errors.

    Raises ValueError for no frames, or numbers that are not finite.
    """
    truth = cosine_weighted(visibility) if settings.weight == "cosine" else visibility
    training = _Training(features, truth, settings, threads)
    part = segments(clip)
    few = _spread(visibility.shape[1], FEW)
    ridge = settings.ridge
    if ridge is None:
        ridge = training.at(few).best_ridge(part) if part.max() > 0 else 0.0
    model = training.fit(ridge)
    errors = _errors(truth, predict(model, features, settings.axes), settings.weight)
    held_out = None
    if part.max() > 0:
        sample = training.at(_spread(visibility.shape[1], SOME))
        held_out = _errors(sample.truth, sample.held_out(part, [ridge])[0], settings.weight)
    lobes = None if training.lobes is None else relative(visibility_of(training.lobes), truth)
    space = training.space
    report = Report(
        errors,
        held_out,
        lobes,
        ridge,
        space.rank,
        model.directions.shape[1],
        int(part.max()) + 1,
        gap(features),
    )
    return model, report


class _Training:
    """Training data with what is fitted to it frame by frame, of all vertices or some."""

    def __init__(
        self,
        features: NDArray[np.float64],
        truth: NDArray[np.float32],
        settings: Settings,
        threads: int,
        lobes: Lobes | None = None,
    ) -> None:
        self.features, self.truth, self.settings, self.threads = features, truth, settings, threads
        if settings.kind == "lobes" and lobes is None:
            lobes = fit_lobes(truth, settings.lobes, threads)
        self.lobes = lobes

    def at(self, vertices: NDArray[np.int64]) -> _Training:
        """The same of some vertices."""
        lobes = None if self.lobes is None else Lobes(*(part[:, vertices] for part in self.lobes))
        return _Training(self.features, self.truth[:, vertices], self.settings, self.threads, lobes)

    def without(self, frames: NDArray[np.bool_]) -> _Training:
        """The same of the other frames. Lobes stay as they were fitted: every frame has its own."""
        lobes = None if self.lobes is None else Lobes(*(part[~frames] for part in self.lobes))
        kept = ~frames
        return _Training(self.features[kept], self.truth[kept], self.settings, self.threads, lobes)

    @cached_property
    def space(self) -> PoseSpace:
        return pose_space(self.features, self.settings.components)

    @cached_property
    def parameters(self) -> Parameters:
        assert self.lobes is not None
        return parameters_of(self.lobes, self.settings.axes)

    def fit(self, ridge: float) -> PoseModel:
        order = math.isqrt(self.truth.shape[2])
        if self.settings.kind == "reduced":
            return self._reduced(ridge, order)
        space = self.space
        scores = space.scores(self.features)
        if self.lobes is None:
            found = regress(scores, space.share, self.truth, ridge, threads=self.threads)
            centre = np.zeros((self.truth.shape[1], 0, 3))
        else:
            count, bands = self.lobes.zonal.shape[2:]
            values = self.parameters
            weight_of = np.full(values.value.shape[2], -1, np.int64)
            if self.settings.axes == LOG:  # an axis means as much as its lobe has energy
                weight_of[1 + count * bands :] = np.repeat(np.arange(count), 2)
            found = regress(scores, space.share, values.value, ridge, values.energy, weight_of, self.threads)
            centre = values.centre
        return PoseModel(space.mean, space.directions, found.intercept, found.slope, centre, order)

    def _reduced(self, ridge: float, order: int) -> PoseModel:
        frames, vertices, _ = self.truth.shape
        mean = self.truth.mean(0, dtype=np.float64)
        centred = self.truth - mean.astype(np.float32)
        gram = np.einsum("fvs,gvs->fg", centred, centred, dtype=np.float64)
        values, vectors = np.linalg.eigh(gram)
        kept = min(self.settings.components, int(np.count_nonzero(values > 1e-10 * values.max(initial=0.0))))
        weights = np.ascontiguousarray(vectors[:, ::-1][:, :kept]) * np.sqrt(frames)  # unit variance
        weights *= np.where(weights.sum(0) < 0.0, -1.0, 1.0) if kept else 1.0
        slope = np.einsum("fk,fvs->vsk", weights / frames, centred)
        # Every component of the poses may speak here: the store keeps few numbers of the map from pose to weights.
        space = pose_space(self.features, frames)
        found = regress(space.scores(self.features), space.share, weights.astype(np.float32)[:, None], ridge, threads=1)
        directions = space.directions @ found.slope[0].T
        intercept = mean + np.einsum("k,vsk->vs", found.intercept[0], slope)
        return PoseModel(space.mean, directions, intercept, slope, np.zeros((vertices, 0, 3)), order)

    def held_out(self, part: NDArray[np.int64], ridges: Sequence[float]) -> list[NDArray[np.float32]]:
        """Per ridge, visibility at every frame as a model predicts it that has not seen the frame's segment."""
        out = [np.empty_like(self.truth) for _ in ridges]
        for k in range(int(part.max()) + 1):
            own = part == k
            rest = self.without(own)
            for found, ridge in zip(out, ridges, strict=True):
                found[own] = predict(rest.fit(ridge), self.features[own], self.settings.axes)
        return out

    def best_ridge(self, part: NDArray[np.int64]) -> float:
        """The ridge whose predictions of held-out frames err least; of equals the smallest."""
        errors = [relative(found, self.truth) for found in self.held_out(part, RIDGES)]
        return RIDGES[int(np.argmin(errors))]


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of the vertices, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64)) if count else np.zeros(0, np.int64)


def relative(values: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
    """RMS difference relative to the RMS of the truth; 0 of nothing and nothing."""
    error = float(((values - truth).astype(np.float64) ** 2).sum())
    norm = float((truth.astype(np.float64) ** 2).sum())
    return math.sqrt(error / norm) if norm > 0.0 else math.sqrt(error)


def _errors(truth: NDArray[np.float32], values: NDArray[np.float32], weight: str) -> Errors:
    error = ((values - truth).astype(np.float64) ** 2).sum(2)
    per_frame = np.sqrt(error.sum(1) / np.maximum((truth.astype(np.float64) ** 2).sum((1, 2)), 1e-300))
    bands, sd = relative(values, truth), float(per_frame.std())
    if weight == "cosine":
        return Errors(None, None, bands, sd)
    # Visibility is 0 or 1, so that the integral of its square is that of itself.
    whole = math.sqrt(4.0 * math.pi) * truth[..., 0].astype(np.float64)
    lost = np.maximum(whole - (truth.astype(np.float64) ** 2).sum(2), 0.0)
    total = float(whole.sum())
    if not total > 0.0:
        return Errors(0.0, 0.0, bands, sd)
    return Errors(math.sqrt(float(lost.sum()) / total), math.sqrt(float((lost + error).sum()) / total), bands, sd)

"""What a sweep found: points with their errors and costs, the fronts, path tracing's own curve, and what follows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

from relightcli.core.measure.front import dominators, pareto_front
from relightcli.stages.tradeoff_measure import PointError

AXES = {"seconds": "simulation", "frame_seconds": "frame", "bytes": "store"}  # a front for each
_TIMED = (("simulation", "seconds", "seconds_spread"), ("a frame", "frame_seconds", "frame_spread"))


@dataclass(frozen=True)
class Measured:
    """A point and what it took. Seconds are the least of the repeats, spreads their largest minus that.

    seconds          of the commands that make the store, whole processes
    picture_seconds  of the process that makes one picture; frame_seconds: of each further frame of a sequence
    bytes            of the store that pictures are made from; peak_bytes: of the largest process
    """

    label: str
    settings: dict[str, str]
    commands: tuple[tuple[str, ...], ...]
    error: PointError
    seconds: float
    seconds_spread: float
    cpu_seconds: float
    picture_seconds: float
    frame_seconds: float
    frame_spread: float
    bytes: int
    peak_bytes: int
    repeats: int

    def cost(self, axis: str) -> float:
        return float(getattr(self, axis))


@dataclass(frozen=True)
class Traced:
    """Path tracing: seconds of a picture, whole process, mean over the views; error from its own variance."""

    spp: int
    seconds: float
    error: float


@dataclass(frozen=True)
class Tracer:
    """What path tracing takes to an error: error = noise / sqrt(spp), seconds = per_sample spp, start-up left out."""

    noise: float
    per_sample: float

    def seconds(self, error: float) -> float:
        return self.per_sample * (self.noise / error) ** 2 if error > 0 else math.inf


@dataclass(frozen=True)
class Ahead:
    """Path tracing at a point's error: seconds a picture, and the number of pictures from which the point takes less
    time in all; None where a frame from the store takes no less than a traced one."""

    traced_seconds: float
    pictures: int | None


def fit_tracer(traced: Sequence[Traced]) -> Tracer:
    """From pictures of several sample counts: error sqrt(spp) of the most, which is least where samples are stratified,
    in favour of tracing; and the slope of seconds from least to most."""
    ordered = sorted(traced, key=lambda t: t.spp)
    low, high = ordered[0], ordered[-1]
    noise = high.error * math.sqrt(high.spp)
    slope = (high.seconds - low.seconds) / (high.spp - low.spp) if high.spp > low.spp else 0.0
    return Tracer(noise, slope if slope > 0 else high.seconds / high.spp)


def ahead(point: Measured, tracer: Tracer) -> Ahead:
    """seconds + picture + (n - 1) frame < n traced. The error is taken with its noise on top, in favour of tracing."""
    traced = tracer.seconds(point.error.error + point.error.noise)
    if math.isinf(traced):
        return Ahead(traced, 1)
    if traced <= point.frame_seconds:
        return Ahead(traced, None)
    start = point.seconds + point.picture_seconds - point.frame_seconds
    return Ahead(traced, max(1, math.floor(start / (traced - point.frame_seconds)) + 1))


@dataclass(frozen=True)
class Result:
    """The whole answer.

    views       names
    impossible  label -> why a point could not be made
    looks       view -> the commands of its pictures, for the reader
    pair_noise  for `pairs`: the standard error of the difference of their squared errors
    """

    scene: str
    views: tuple[str, ...]
    spp: int
    bounces: int
    tolerance: float
    machine: str
    workers: int
    points: tuple[Measured, ...]
    traced: tuple[Traced, ...]
    impossible: dict[str, str]
    looks: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    pair_noise: Mapping[tuple[int, int], float] = field(default_factory=dict)

    def fronts(self) -> dict[str, list[int]]:
        """Per axis the points of its front, in ascending order of cost."""
        return {a: pareto_front([(p.error.error, p.cost(a)) for p in self.points]) for a in AXES}

    def on_front(self) -> list[int]:
        """Points on any front, by error."""
        found = {k for front in self.fronts().values() for k in front}
        return sorted(found, key=lambda k: self.points[k].error.error)

    def dominated_by(self) -> list[int | None]:
        """Per point one that is nowhere worse: in error, seconds of simulation and of a frame, and bytes."""
        return dominators([(p.error.error, *(p.cost(a) for a in AXES)) for p in self.points])

    def tracer(self) -> Tracer:
        return fit_tracer(self.traced)

    def cheapest(self) -> int | None:
        """The point whose store takes the least time of those within the tolerance, the error's noise included."""
        fine = [k for k, p in enumerate(self.points) if p.error.error + p.error.noise <= self.tolerance]
        return min(fine, key=lambda k: (self.points[k].seconds, k), default=None)

    def remarks(self) -> list[str]:
        """What the numbers say: a line each."""
        points = self.points
        best = self.cheapest()
        lines = [self._within_tolerance(best)]
        lines += [_ahead_text(p, ahead(p, self.tracer())) for p in ([points[best]] if best is not None else points[:1])]
        for k, by in enumerate(self.dominated_by()):
            if by is not None:
                lines.append(f"{points[k].label} is dominated by {points[by].label}: nowhere better, somewhere worse.")
        lines += [f"{label} could not be made: {why}" for label, why in self.impossible.items()]
        return lines

    def _within_tolerance(self, best: int | None) -> str:
        if best is not None:
            p = self.points[best]
            return (
                f"The cheapest point with an error of at most {self.tolerance:.2%} is: {p.label} "
                f"({p.error.error:.2%}, {p.seconds:.1f} s, {p.bytes / 1e6:.1f} MB)."
            )
        p = min(self.points, key=lambda q: q.error.error)
        if p.error.error <= self.tolerance:
            return (
                f"Whether a point keeps the error under {self.tolerance:.2%} is not known: that of {p.label} is "
                f"{p.error.error:.2%} or up to {p.error.noise:.2%} more. A larger --spp would tell."
            )
        return f"No point keeps the error under {self.tolerance:.2%}; the least is {p.error.error:.2%}: {p.label}."

    def pairs(self) -> list[tuple[int, int]]:
        """Points whose order is told: neighbours on a front of time, and dominated ones with what dominates them."""
        fronts = self.fronts()
        found = [pair for axis in ("seconds", "frame_seconds") for pair in pairwise(fronts[axis])]
        found += [(k, by) for k, by in enumerate(self.dominated_by()) if by is not None]
        return sorted({(min(pair), max(pair)) for pair in found})

    def undecided(self) -> list[str]:
        """A line for pairs that differ by less than repeats of one point do, or than the references' noise."""
        lines = []
        for i, j in self.pairs():
            p, q = self.points[i], self.points[j]
            for what, axis, spread in _TIMED:
                widest, apart = max(getattr(p, spread), getattr(q, spread)), abs(p.cost(axis) - q.cost(axis))
                if widest > apart:
                    lines.append(
                        f"{p.label} and {q.label}: the seconds of {what} differ by {apart:.2g}, those of repeats by "
                        f"{widest:.2g}; which is faster is not known."
                    )
            noise, apart = self.pair_noise.get((i, j), 0.0), abs(p.error.error**2 - q.error.error**2)
            if noise > apart:
                lines.append(
                    f"{p.label} and {q.label}: their errors, {p.error.error:.2%} and {q.error.error:.2%}, differ by "
                    "less than the references' noise; which is more exact is not known."
                )
        return lines

    def to_json(self) -> dict[str, Any]:
        """Plain data for `json.dumps`, all numbers finite."""
        tracer, fronts, by = self.tracer(), self.fronts(), self.dominated_by()
        points = []
        for k, p in enumerate(self.points):
            gain = ahead(p, tracer)
            points.append(
                {
                    **{key: value for key, value in asdict(p).items() if key != "error"},
                    **asdict(p.error),
                    "commands": [" ".join(c) for c in p.commands],
                    "front": [AXES[a] for a in AXES if k in fronts[a]],
                    "dominated_by": None if by[k] is None else self.points[by[k] or 0].label,
                    "traced_seconds": gain.traced_seconds if math.isfinite(gain.traced_seconds) else None,
                    "ahead_from_pictures": gain.pictures,
                }
            )
        return {
            "scene": self.scene,
            "views": list(self.views),
            "reference": {"spp": self.spp, "bounces": self.bounces},
            "tolerance": self.tolerance,
            "machine": self.machine,
            "workers": self.workers,
            "points": points,
            "path_tracing": [asdict(t) for t in self.traced],
            "impossible": self.impossible,
            "remarks": self.remarks(),
            "undecided": self.undecided(),
        }


def _ahead_text(point: Measured, gain: Ahead) -> str:
    if not math.isfinite(gain.traced_seconds):
        return f"{point.label}: no error was measured, which path tracing never reaches."
    same = f"{point.label}: path tracing to the same error takes {gain.traced_seconds:.2f} s a picture"
    if gain.pictures is None:
        return f"{same}, no more than a frame from the store ({point.frame_seconds:.2f} s): it stays ahead."
    count = "every picture takes" if gain.pictures == 1 else f"{gain.pictures} pictures or more take"
    return f"{same}; with the store, {count} less time in all."

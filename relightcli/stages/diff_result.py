"""What `diff` is asked and what it answers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from relightcli.errors import InputError

METRICS = ("rmse", "relrmse", "psnr", "flip")


@dataclass(frozen=True)
class DiffSettings:
    """metrics: of `METRICS`, the first leads (heat map, worst frame). fail: threshold per metric; a value above it
    fails (PSNR: below it). fail_percent: fail only where more than this percentage of pixels is beyond the threshold.
    """

    metrics: tuple[str, ...] = ("relrmse",)
    fail: Mapping[str, float] = field(default_factory=dict)
    fail_percent: float | None = None
    heatmap: Path | None = None
    report: Path | None = None

    def threshold(self, metric: str) -> float:
        """The threshold of a metric; by default any difference fails."""
        return self.fail.get(metric, math.inf if metric == "psnr" else 0.0)

    def judges(self, metric: str) -> bool:
        """Whether a metric can fail: those with a threshold, or all where none has one."""
        return not self.fail or metric in self.fail

    @property
    def exact(self) -> bool:
        """No difference whatsoever is let through, layers and alpha included."""
        return not self.fail and self.fail_percent is None


@dataclass(frozen=True)
class Comparison:
    """One pair of pictures, or of arrays of a store.

    values: metric -> value; percent: metric -> percentage of pixels beyond the threshold; both empty where something is
    not finite. parts: layer, alpha or other channel -> metric -> value. reasons: why it fails, empty if it does not.
    """

    name: str
    values: Mapping[str, float]
    percent: Mapping[str, float]
    parts: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return not self.reasons


@dataclass(frozen=True)
class DiffResult:
    """The whole answer. kind: image, sequence or store. notes: remarks on the pair as a whole."""

    kind: str
    a: str
    b: str
    settings: DiffSettings
    comparisons: tuple[Comparison, ...]
    notes: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return all(item.passed for item in self.comparisons)

    def worst(self) -> Comparison:
        """The comparison that is worst by the first metric; one that is not finite is worse than any."""
        metric = self.settings.metrics[0]
        sign = -1 if metric == "psnr" else 1
        return max(self.comparisons, key=lambda item: sign * item.values[metric] if item.values else math.inf)

    def to_json(self) -> dict[str, Any]:
        """Plain data for `json.dumps`. Infinite values are the strings "Infinity" and "-Infinity"."""
        settings = self.settings
        return {
            "command": "diff",
            "kind": self.kind,
            "a": self.a,
            "b": self.b,
            "passed": self.passed,
            "fail": {m: _number(settings.threshold(m)) if settings.judges(m) else None for m in settings.metrics},
            "fail_percent": settings.fail_percent,
            "worst": self.worst().name,
            "heatmap": str(settings.heatmap) if settings.heatmap else None,
            "report": str(settings.report) if settings.report else None,
            "notes": list(self.notes),
            "items": [
                {
                    "name": item.name,
                    "passed": item.passed,
                    "metrics": _numbers(item.values),
                    "percent_beyond": _numbers(item.percent),
                    "parts": {name: _numbers(values) for name, values in item.parts.items()},
                    "reasons": list(item.reasons),
                    "notes": list(item.notes),
                }
                for item in self.comparisons
            ],
        }


def parse_thresholds(texts: Sequence[str], metrics: Sequence[str]) -> dict[str, float]:
    """Thresholds from `--fail X` (every metric) and `--fail METRIC=X`.

    Raises InputError for anything that is not a number >= 0, for metrics not asked for, and for one X that is to hold
    for PSNR, where more is better, and for another metric, where less is.
    """
    thresholds: dict[str, float] = {}
    for text in texts:
        metric, _, value = text.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and number >= 0):
            raise InputError(f"--fail {text}: expected a number of at least 0, or METRIC=NUMBER.")
        if metric and metric not in metrics:
            raise InputError(f"--fail {text}: {metric} is not measured; expected one of {', '.join(metrics)}.")
        if not metric and "psnr" in metrics and len(metrics) > 1:
            raise InputError(f"--fail {text}: one threshold cannot serve psnr and others; write --fail METRIC=NUMBER.")
        thresholds |= dict.fromkeys([metric] if metric else metrics, number)
    return thresholds


def judge(values: Mapping[str, float], percent: Mapping[str, float], settings: DiffSettings) -> list[str]:
    """Why a picture or an array fails its thresholds: one line per metric, none if it passes."""
    if settings.exact:
        equal = all(math.isinf(v) if metric == "psnr" else v == 0 for metric, v in values.items())
        return [] if equal else ["differs; expected no difference, because no --fail was given."]
    reasons = []
    for metric, value in values.items():
        if not settings.judges(metric):
            continue
        limit = settings.threshold(metric)
        if settings.fail_percent is not None:
            if percent[metric] > settings.fail_percent:
                reasons.append(
                    f"{percent[metric]:.4g} % of the pixels are beyond {metric} {limit:g}; "
                    f"at most {settings.fail_percent:g} % may be."
                )
        elif metric == "psnr" and value < limit:
            reasons.append(f"psnr is {value:.5g} dB; expected at least {limit:g}.")
        elif metric != "psnr" and value > limit:
            reasons.append(f"{metric} is {value:.5g}; expected at most {limit:g}.")
    return reasons


def _numbers(values: Mapping[str, float]) -> dict[str, float | str]:
    return {key: _number(value) for key, value in values.items()}


def _number(value: float) -> float | str:
    if math.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return value

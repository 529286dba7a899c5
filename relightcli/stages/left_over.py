"""What the stages before have left of a store's tolerance, and what of it the next stage may take.

Errors of different origin add up in squares. A store says in `measured_error` what all that precompute does costs, with
its tolerance; stages after it add to `spent` what they know they cost. What is left over is

    (T^2 - measured^2 - sum of spent^2)^(1/2)

and not less than LEAST of T: a stage that had nothing to take would never end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import relight_formats as formats

LEAST = 0.25  # of the tolerance
MOST_BASIS, LEAST_BASIS = 0.1, 0.001  # of interreflections, that the basis for light may leave out
# Shares of what is left over, in squares; the rest is for rounding and second bounces.
BASIS, DIRECT, RANKS = 0.2, 0.5, 0.2


@dataclass(frozen=True)
class LeftOver:
    """tolerance: of the store; left: of it; bounced: the share of the light that interreflections carry, at most."""

    tolerance: float
    left: float
    bounced: float

    def part(self, square: float) -> float:
        """Relative RMS of all light, for a part with this share of the squares."""
        return math.sqrt(square) * self.left

    def of_bounces(self, square: float) -> float:
        """The same as a share of the light of interreflections."""
        return self.part(square) / max(self.bounced, 1e-3)


def left_over(store: formats.Store, tolerance: float | None = None) -> LeftOver | None:
    """What is left of `tolerance`, or else of the store's own; None where neither is known."""
    measured: dict[str, Any] = store.attrs.get("measured_error", {})
    tolerance = measured.get("tolerance") if tolerance is None else tolerance
    if tolerance is None:
        return None
    squares = [float(measured.get("share", 0.0)), *(float(one["share"]) for one in store.attrs.get("spent", []))]
    left = tolerance**2 - sum(share**2 for share in squares)
    bounds = [row["bound"] for row in store.attrs.get("plan", []) if row["effect"] == "one-bounce" and "bound" in row]
    return LeftOver(tolerance, math.sqrt(max(left, (LEAST * tolerance) ** 2)), min(1.0, *bounds, 1.0))


def basis_tolerance(store: formats.Store) -> float | None:
    """Share of interreflections that the basis for light may leave out; None where the store has no tolerance."""
    found = left_over(store)
    return None if found is None else min(MOST_BASIS, max(LEAST_BASIS, found.of_bounces(BASIS)))


def spend(store: formats.Store, stage: str, share: float) -> list[dict[str, Any]]:
    """The attribute `spent` of a store made from `store`: a stage has cost this share of all light."""
    return [*store.attrs.get("spent", []), {"stage": stage, "share": share}]

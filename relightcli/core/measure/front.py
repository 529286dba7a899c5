"""Which of several choices are worth having: the Pareto front of error against cost.

A choice is dominated where another is nowhere worse and somewhere better. Equal choices do not dominate each other.
"""

from __future__ import annotations

from collections.abc import Sequence


def dominates(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether choice `a` is nowhere worse (larger) than `b`, and better in at least one respect."""
    return all(x <= y for x, y in zip(a, b, strict=True)) and any(x < y for x, y in zip(a, b, strict=True))


def dominators(costs: Sequence[Sequence[float]]) -> list[int | None]:
    """For every choice the one that dominates it, by index; None where nothing does.

    costs: N choices, each with the same number of finite values (error, seconds, bytes, ...), less is better. Of
    several dominators the one with the least first value is named, then the least second, and so on; it is undominated.
    """
    found: list[int | None] = []
    for mine in costs:
        better = [k for k, other in enumerate(costs) if dominates(other, mine)]
        found.append(min(better, key=lambda k: (tuple(costs[k]), k), default=None))
    return found


def pareto_front(costs: Sequence[Sequence[float]]) -> list[int]:
    """Indices of the choices that no other dominates, in ascending order of the second value (the cost).

    costs: N pairs (error, cost).
    """
    free = [k for k, by in enumerate(dominators(costs)) if by is None]
    return sorted(free, key=lambda k: (costs[k][1], costs[k][0], k))

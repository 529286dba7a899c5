"""A kernel, its stress, and what it loses: `digits lost` is log10(error / unit round-off of what it is stored in).

The reference is worked out in mpmath with 50 digits from the very same floating-point inputs, by other formulas than
the kernel's where there are any. The error is elementwise, relative to the reference, or to a scale that a case names
where elementwise is no fair question (a coefficient that is a difference of large ones has the scale of those).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import mpmath
import numpy as np

mpmath.mp.dps = 50
mp = mpmath.mp

# What rounding to nearest costs.
UNIT = {"float64": 2.0**-53, "float32": 2.0**-24}


@dataclass(frozen=True)
class Case:
    """kernel: what is looked at; modules: files of `relightcli/core` that it belongs to; stress: over what; storage:
    type of the result; bound: digits that may be lost; why: where that bound comes from."""

    kernel: str
    modules: tuple[str, ...]
    stress: str
    storage: str
    bound: float
    why: str
    measure: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Loss:
    """What a case measured: largest and median relative error, and the digits lost in the worst element."""

    kernel: str
    stress: str
    storage: str
    largest: float
    median: float
    lost: float
    bound: float
    why: str

    @property
    def met(self) -> bool:
        return bool(self.lost <= self.bound)

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"met": self.met}


CASES: list[Case] = []


def case(
    kernel: str, modules: str, stress: str, storage: str, bound: float, why: str
) -> Callable[[Callable[[], np.ndarray]], Callable[[], np.ndarray]]:
    """Registers a function that returns the errors of a kernel, relative and of any shape."""

    def register(measure: Callable[[], np.ndarray]) -> Callable[[], np.ndarray]:
        CASES.append(Case(kernel, tuple(modules.split()), stress, storage, bound, why, measure))
        return measure

    return register


def run(one: Case) -> Loss:
    """Measures. Anything that is not finite counts as an infinite loss."""
    error = np.abs(np.asarray(one.measure(), np.float64)).reshape(-1)
    assert error.size
    largest = float(error.max()) if np.isfinite(error).all() else math.inf
    lost = max(0.0, math.log10(largest / UNIT[one.storage])) if largest > 0.0 else 0.0
    return Loss(one.kernel, one.stress, one.storage, largest, float(np.median(error)), lost, one.bound, one.why)


def relative(found: Any, reference: Any, scale: Any = None) -> np.ndarray:
    """|found - reference| / |reference|, or over `scale`; 0 where both are 0, infinite where only the scale is.

    found: floats; reference: mpf or floats of the same shape; scale: broadcasts.
    """
    found, reference = np.asarray(found), np.asarray(reference, object)
    size = np.broadcast_to(np.asarray(reference if scale is None else scale, object), found.shape)
    assert found.shape == reference.shape
    out = np.empty(found.size)
    rows = zip(found.reshape(-1).tolist(), reference.reshape(-1).tolist(), size.reshape(-1).tolist(), strict=True)
    for k, (x, y, s) in enumerate(rows):
        if not math.isfinite(x):
            out[k] = math.inf
            continue
        away = abs(mp.mpf(x) - y)
        out[k] = 0.0 if away == 0 else (math.inf if s == 0 else float(away / abs(mp.mpf(s))))
    return out.reshape(found.shape)


def mpf(values: Any) -> np.ndarray:
    """An array of floats as exact numbers of the reference's precision."""
    flat = np.asarray(values)
    out = np.empty(flat.size, object)
    for k, x in enumerate(flat.reshape(-1).tolist()):
        out[k] = mp.mpf(x)
    return out.reshape(flat.shape)


def numbers(values: Iterable[Any], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """mpf results as an array of objects."""
    flat = list(values)
    out = np.empty(len(flat), object)
    out[:] = flat
    return out if shape is None else out.reshape(shape)


def dot(a: Any, b: Any) -> Any:
    return mp.fsum(x * y for x, y in zip(a, b, strict=True))


def norm(a: Any) -> Any:
    return mp.sqrt(dot(a, a))


def unit(a: Any) -> list[Any]:
    length = norm(a)
    return [x / length for x in a]


def legendre(degree: int, t: Any) -> Any:
    """P_degree(t)."""
    low, value = mp.mpf(0), mp.mpf(1)
    for n in range(degree):
        low, value = value, ((2 * n + 1) * t * value - n * low) / (n + 1)
    return value


def powers(degree: int, derivative: int = 0) -> list[Any]:
    """Coefficients in t of P_degree, or of a derivative of it, exact."""
    out = [mp.mpf(0)] * (degree + 1)
    for k in range(degree // 2 + 1):
        top = degree - 2 * k
        below = math.factorial(k) * math.factorial(degree - k) * math.factorial(top)
        out[top] = (-1) ** k * mp.mpf(math.factorial(2 * degree - 2 * k) // below) / 2**degree
    for _ in range(derivative):
        out = [k * c for k, c in enumerate(out)][1:]
    return out


def times(a: list[Any], b: list[Any]) -> list[Any]:
    """The product of two polynomials."""
    out = [mp.mpf(0)] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            out[i + j] += x * y
    return out


def harmonics(direction: Any, order: int) -> list[Any]:
    """Real orthonormal y_i without the Condon-Shortley phase of one direction of any length, index l (l + 1) + m."""
    x, y, z = unit([mp.mpf(c) for c in direction])
    out = [mp.mpf(0)] * (order * order)
    power = mp.mpc(1)
    for m in range(order):
        for band in range(m, order):
            value = mp.fsum(c * z**k for k, c in enumerate(powers(band, m)))
            size = mp.sqrt(mp.mpf(2 * band + 1) / (4 * mp.pi) * math.factorial(band - m) / math.factorial(band + m))
            if m:
                size *= mp.sqrt(2)
                out[band * (band + 1) - m] = size * value * power.imag
            out[band * (band + 1) + m] = size * value * power.real
        power *= mp.mpc(x, y)
    return out


def directions(count: int, seed: int, near: float = 0.0) -> np.ndarray:
    """Unit directions (count, 3): random ones, or within `near` radians of the axes +Z and -Z."""
    rng = np.random.default_rng(seed)
    if near:
        angle, turn = near * rng.random(count), 2 * np.pi * rng.random(count)
        sign = np.where(np.arange(count) % 2, -1.0, 1.0)
        return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), sign * np.cos(angle)], -1)
    d = rng.standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)

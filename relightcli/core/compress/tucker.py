"""Tucker decomposition of a 3-way tensor: HOSVD, HOOI, a faster HOSVD. [De Lathauwer 2000; Sun 2007, Eq. 2]

    X(a, b, c) = sum over i, j, k of G(i, j, k) U0(a, i) U1(b, j) U2(c, k) + error,   G = X x0 U0' x1 U1' x2 U2'

with orthonormal columns in every U, so |error|^2 = |X|^2 - |G|^2. A mode without a rank stays as it is (Tucker-2).
HOOI alternates: each U becomes the leading left singular vectors of X with the other modes projected. The error never
rises from sweep to sweep, but what it comes to is a local optimum, not "the best trilinear factorization" [Sun 2007,
sec. 3.2]: only a matrix has that guarantee.

Singular vectors come from Gram matrices in float64. Two limits follow: singular values below about 1e-7 of the largest
count as zero (such directions are never returned), and an error^2 below about 1e-15 |X|^2 is round-off. The faster one
finds them by subspace iteration in float32.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, lu

from relightcli.errors import NumericalError

MODES = (0, 1, 2)
MAXIMUM_SWEEPS = 20
# Relative change of error^2 at which a sweep was the last.
_CONVERGED = 1e-6
# What round-off may add to error^2, relative to |X|^2.
_ROUND_OFF = 1e-12
# Neighbouring eigenvalues closer than this, relative, belong to one pair (cos m phi, sin m phi).
_PAIR = 0.02
# Subspace iteration: columns beyond the rank, and passes.
_SPARE, _POWER = 16, 2
# Columns of an unfolding that are turned into float64 at a time.
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class Tucker:
    """core (r0, r1, r2) float64; factors: per mode (size, rank) float64 with orthonormal columns, largest component of
    each positive, or None for a mode that is not compressed.

    norm2 = |X|^2; errors: error^2 of the HOSVD and after every sweep, never rising; closed: the modes whose rank was
    moved up so that no pair is cut.
    """

    core: NDArray[np.float64]
    factors: tuple[NDArray[np.float64] | None, ...]
    norm2: float
    errors: tuple[float, ...]
    closed: tuple[int, ...]

    @property
    def error2(self) -> float:
        """|X - reconstruction|^2."""
        return self.errors[-1]


def hosvd(x: NDArray[np.floating[Any]], ranks: Sequence[int | None], paired: Collection[int] = ()) -> Tucker:
    """Leading singular vectors of every unfolding of x (n0, n1, n2); see `hooi` for the parameters."""
    return _decompose(x, ranks, paired, 0)


def hooi(
    x: NDArray[np.floating[Any]],
    ranks: Sequence[int | None],
    paired: Collection[int] = (),
    sweeps: int = MAXIMUM_SWEEPS,
) -> Tucker:
    """Higher-order orthogonal iteration from the HOSVD, until error^2 changes by less than 1e-6 or `sweeps` are over.

    x: (n0, n1, n2), float32 or float64. ranks: wanted rank of each mode, at least 1, or None to leave the mode. A rank
    is cut down to what the data has. paired: modes in which pairs of equal singular values are kept whole
    (`pair_safe_rank`). Raises NumericalError if x is not finite or if the error rises by more than round-off.
    """
    return _decompose(x, ranks, paired, sweeps)


def sequential_hosvd(x: NDArray[np.float32], ranks: Sequence[int | None]) -> Tucker:
    """Mode after mode, each found in what the modes before it have left, by subspace iteration: for large tensors.

    The modes that shrink most go first. [Vannieuwenhoven, Vandebril, Meerbergen 2012; Halko, Martinsson, Tropp 2011,
    algorithm 4.4] x: (n0, n1, n2) float32, as are products; ranks as in `hooi`. error^2 is what the core lacks,
    measured, and within a few parts in a thousand of that of the best subspaces.
    """
    norm2, modes = _checked(x, ranks)
    factors: dict[int, NDArray[np.float64]] = {}
    y: NDArray[np.floating[Any]] = x
    for mode in sorted(modes, key=lambda m: int(ranks[m] or 0) / x.shape[m]):
        rank = min(int(ranks[mode] or 0), x.shape[mode])
        unfolded = np.moveaxis(y, mode, 0).reshape(y.shape[mode], -1)
        factors[mode] = _leading(np.ascontiguousarray(unfolded, np.float32), rank)
        y = mode_product(y, factors[mode].T.astype(np.float32), mode)
    core = np.asarray(y, np.float64)
    return Tucker(core, tuple(factors.get(mode) for mode in MODES), norm2, (_error2(norm2, core),), ())


def _leading(flat: NDArray[np.float32], rank: int) -> NDArray[np.float64]:
    """The `rank` leading left singular vectors of a matrix (n, m), fewer if it has fewer; (n, r) by the sign rule."""
    n, m = flat.shape
    width = min(rank + _SPARE, n, m)
    if width == n:  # no subspace to look for: all of it is asked for
        return gram_spectrum(mode_gram(flat[:, :, None], 0))[1][:, :rank]
    block = np.random.default_rng(0).standard_normal((m, width)).astype(np.float32)
    q = flat @ block
    for _ in range(_POWER):  # between two products any well-conditioned basis will do, and LU is the cheapest
        q = flat @ _basis(flat.T @ _basis(q))
    q = np.linalg.qr(q)[0]
    small = (q.T @ flat).astype(np.float64)
    _, vectors = gram_spectrum(small @ small.T)
    found: NDArray[np.float64] = np.linalg.qr(q.astype(np.float64) @ vectors[:, :rank])[0]  # float32 is not orthonormal
    return signed(found)


def _basis(columns: NDArray[np.float32]) -> NDArray[np.float32]:
    """Another basis (n, w) of what the columns span: unit lower triangular but for the order of rows."""
    found: NDArray[np.float32] = lu(columns, permute_l=True, check_finite=False)[0]
    return found


def pair_safe_rank(spectrum: NDArray[np.float64], rank: int) -> int:
    """`rank`, or one more where it would cut a pair. spectrum: eigenvalues, falling; those at the end may be 0.

    An isotropic function of directions has its singular vectors in pairs (cos m phi, sin m phi) of equal singular
    value, for every m > 0; cutting one makes the function anisotropic. Neighbours that differ by less than 2 % count
    as a pair, the closest first, and none is in two pairs.
    """
    if rank >= len(spectrum):
        return len(spectrum)
    upper, lower = spectrum[:-1], spectrum[1:]
    gap = np.divide(upper - lower, upper, out=np.full(len(upper), np.inf), where=lower > 0.0)
    taken = np.zeros(len(spectrum), bool)
    for k in np.argsort(gap, kind="stable"):
        if gap[k] >= _PAIR:
            break
        if not (taken[k] or taken[k + 1]):
            taken[k : k + 2] = True
            if k == rank - 1:
                return rank + 1
    return rank


def gram_spectrum(gram: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eigenvalues (r,), falling, and eigenvectors (n, r) of a Gram matrix (n, n), by the sign rule; r >= 1 is the
    numerical rank. Of a zero matrix: the value 0 and the first unit vector."""
    values, vectors = eigh(gram, driver="evd", check_finite=False)
    values, vectors = values[::-1], vectors[:, ::-1]
    if not values[0] > 0.0:
        return np.zeros(1), np.eye(len(gram), 1)
    rank = int(np.count_nonzero(values > len(gram) * np.finfo(np.float64).eps * values[0]))
    return values[:rank], signed(vectors[:, :rank])


def signed(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns with their largest component made positive."""
    largest = np.abs(vectors).argmax(0)
    sign = np.where(vectors[largest, np.arange(vectors.shape[1])] < 0.0, -1.0, 1.0)
    return vectors * sign


def mode_product(x: NDArray[np.floating[Any]], matrix: NDArray[np.float64], mode: int) -> NDArray[np.float64]:
    """X x_mode matrix: the sum over that index of x with matrix (new size, old size)."""
    n0, n1, n2 = x.shape
    if mode == 0:
        return (matrix @ x.reshape(n0, n1 * n2)).reshape(-1, n1, n2)
    if mode == 1:
        return np.matmul(matrix, x)
    return (x.reshape(n0 * n1, n2) @ matrix.T).reshape(n0, n1, -1)


def mode_gram(x: NDArray[np.floating[Any]], mode: int) -> NDArray[np.float64]:
    """Gram matrix (size, size) float64 of the unfolding of x along `mode`, without a copy of x."""
    n0, n1, n2 = x.shape
    gram = np.zeros((x.shape[mode], x.shape[mode]))
    if mode == 1:
        for slab in x:
            part = slab.astype(np.float64, copy=False)
            gram += part @ part.T
        return gram
    flat = x.reshape(n0, n1 * n2) if mode == 0 else x.reshape(n0 * n1, n2).T
    for start in range(0, flat.shape[1], _BLOCK):
        part = flat[:, start : start + _BLOCK].astype(np.float64, copy=False)
        gram += part @ part.T
    return gram


def reconstruct(decomposition: Tucker) -> NDArray[np.float64]:
    """G x0 U0 x1 U1 x2 U2: (n0, n1, n2) float64."""
    x = decomposition.core
    for mode in MODES:
        factor = decomposition.factors[mode]
        if factor is not None:
            x = mode_product(x, factor, mode)
    return x


def _decompose(
    x: NDArray[np.floating[Any]], ranks: Sequence[int | None], paired: Collection[int], sweeps: int
) -> Tucker:
    norm2, modes = _checked(x, ranks)
    wanted: dict[int, int] = {mode: int(ranks[mode] or 0) for mode in modes}
    factors: dict[int, NDArray[np.float64]] = {}
    closed: set[int] = set()

    def update(y: NDArray[np.floating[Any]], mode: int) -> None:
        values, vectors = gram_spectrum(mode_gram(y, mode))
        if mode in paired:
            # Never back down: a rank that shrank between sweeps could let the error rise.
            safe = pair_safe_rank(values, wanted[mode])
            if safe > wanted[mode]:
                wanted[mode] = safe
                closed.add(mode)
        factors[mode] = np.ascontiguousarray(vectors[:, : wanted[mode]])

    def projected(skip: int | None) -> NDArray[np.floating[Any]]:
        y = x
        # The mode that shrinks most goes first.
        for mode in sorted((m for m in modes if m != skip), key=lambda m: factors[m].shape[1] / x.shape[m]):
            y = mode_product(y, factors[mode].T, mode)
        return y

    for mode in modes:
        update(x, mode)
    core = np.asarray(projected(None), np.float64)
    errors = [_error2(norm2, core)]
    for _ in range(sweeps):
        for mode in modes:
            update(projected(mode), mode)
        core = np.asarray(projected(None), np.float64)
        errors.append(_error2(norm2, core))
        if errors[-1] > errors[-2] + _ROUND_OFF * norm2:
            raise NumericalError(
                f"the error of a tensor factorisation rose in sweep {len(errors) - 1}: expected at most "
                f"{errors[-2]:.17g}, found {errors[-1]:.17g}."
            )
        if errors[-2] - errors[-1] <= _CONVERGED * errors[-2]:
            break
    return Tucker(core, tuple(factors.get(mode) for mode in MODES), norm2, tuple(errors), tuple(sorted(closed)))


def _checked(x: NDArray[np.floating[Any]], ranks: Sequence[int | None]) -> tuple[float, list[int]]:
    """|X|^2, and the modes to compress."""
    if x.ndim != 3 or x.size == 0 or len(ranks) != 3 or any(r is not None and r < 1 for r in ranks):
        raise ValueError(f"expected a 3-way tensor and three ranks of at least 1; found {x.shape} and {tuple(ranks)}")
    norm2 = sum(float(np.vdot(part, part)) for part in (x[k].astype(np.float64) for k in range(len(x))))
    if not math.isfinite(norm2):
        raise NumericalError("a tensor to be factorised has values that are not finite, or its square overflows.")
    return norm2, [mode for mode in MODES if ranks[mode] is not None]


def _error2(norm2: float, core: NDArray[np.float64]) -> float:
    return max(0.0, norm2 - float(np.vdot(core, core)))

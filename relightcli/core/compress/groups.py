"""Receivers in groups of about the same size, however many there are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from relightcli.core.compress.cpca import cpca
from relightcli.core.compress.tucker import gram_spectrum

TERMS = 16  # eigenvectors of a group
TOGETHER = 1 << 16  # rows that are grouped at a time
LARGEST = 2.0  # a group of more than so many times the mean is cut: what it costs goes with the square


def grouped(rows: NDArray[np.float32], clusters: int, seed: int, threads: int) -> tuple[NDArray[np.int32], float]:
    """Label (N,) of rows (N, D) in about `clusters` groups, and the relative RMS that their eigenvectors leave.

    More than TOGETHER rows are cut into even parts first: comparing all of them with all clusters, whose number grows
    with theirs, would take time with the square.
    """
    part = split_large(rows, np.zeros(len(rows), np.int32), TOGETHER)
    label, count, residual, norm2 = np.empty(len(rows), np.int32), 0, 0.0, 0.0
    for p in range(int(part.max(initial=0)) + 1):
        members = np.flatnonzero(part == p)
        found = cpca(rows[members], max(1, round(clusters * len(members) / len(rows))), TERMS, seed, threads)
        label[members] = count + found.label
        count, residual, norm2 = count + found.count, residual + found.residuals[-1], norm2 + found.norm2
    label = split_large(rows, label, int(LARGEST * len(rows) / count) + 1)
    return label, float(np.sqrt(residual / norm2)) if norm2 else 0.0


def split_large(rows: NDArray[np.floating[Any]], label: NDArray[np.int32], most: int) -> NDArray[np.int32]:
    """Labels with every cluster of more than `most` rows cut into even parts along its first principal direction."""
    out, new = label.copy(), int(label.max(initial=-1)) + 1
    for c in range(new):
        members = np.flatnonzero(label == c)
        parts = -(-len(members) // most)
        if parts < 2:
            continue
        cuts = range(0, len(members), TOGETHER)
        mean = sum(rows[members[a : a + TOGETHER]].sum(0, dtype=np.float64) for a in cuts) / len(members)
        centred = (rows[members[a : a + TOGETHER]] - mean for a in cuts)
        _, vectors = gram_spectrum(sum(own.T @ own for own in centred))
        centred = (rows[members[a : a + TOGETHER]] - mean for a in cuts)
        order = members[np.argsort(np.concatenate([own @ vectors[:, 0] for own in centred]), kind="stable")]
        for part in np.array_split(order, parts)[1:]:
            out[part] = new
            new += 1
    return out

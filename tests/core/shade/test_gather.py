"""Rows of a gather that are put in the place of others."""

from __future__ import annotations

import numpy as np

from relightcli.core.shade.gather import Gather, join, replace_rows


def gather(counts, first):
    """Entries that tell where they come from."""
    n = int(np.sum(counts))
    number = np.arange(first, first + n)
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    cosine = (number + 0.5).astype(np.float32)
    return Gather(8, start, number.astype(np.int32), (number % 384).astype(np.int16), cosine, 2 * cosine)


def rows_of(found):
    ends = zip(found.start[:-1], found.start[1:], strict=True)
    return [tuple(part[a:b].tolist() for part in found[2:]) for a, b in ends]


def test_rows_are_replaced_and_the_others_stay():
    rng = np.random.default_rng(0)
    whole = gather(rng.integers(0, 5, 40), 0)
    rows = np.sort(rng.permutation(40)[:11]).astype(np.int64)
    part = gather(rng.integers(0, 7, 11), 1000)
    found = replace_rows(whole, rows, part)
    expected = rows_of(whole)
    for row, entries in zip(rows, rows_of(part), strict=True):
        expected[row] = entries
    assert rows_of(found) == expected
    for a, b in zip(found, whole, strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype


def test_none_and_all_of_the_rows():
    whole = gather([2, 0, 3], 0)
    same = replace_rows(whole, np.zeros(0, np.int64), gather([], 9))
    assert rows_of(same) == rows_of(whole)
    other = gather([1, 4, 0], 50)
    assert rows_of(replace_rows(whole, np.arange(3), other)) == rows_of(other)
    assert rows_of(join([whole, other])) == rows_of(whole) + rows_of(other)

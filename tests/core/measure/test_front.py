"""Fronts against the definition, and by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relightcli.core.measure.front import dominates, dominators, pareto_front


def test_by_hand():
    # Error, seconds: 1 is worse than 0 in both, 3 equals 2, 4 ties 0 in error and loses in time.
    costs = [(0.1, 1.0), (0.2, 2.0), (0.05, 3.0), (0.05, 3.0), (0.1, 1.5)]
    assert pareto_front(costs) == [0, 2, 3]
    assert dominators(costs) == [None, 0, None, None, 0]


def test_nothing_dominates_itself_or_an_equal():
    assert not dominates((1, 2), (1, 2))
    assert dominates((1, 2), (1, 3))
    assert not dominates((1, 4), (2, 3))


def test_different_lengths_are_an_error():
    with pytest.raises(ValueError, match="shorter"):
        dominates((1, 2, 3), (1, 2))


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12))
def test_the_front_is_what_no_point_beats(costs):
    front = pareto_front(costs)
    expected = {k for k, c in enumerate(costs) if not any(np.all(np.less_equal(o, c)) and o != c for o in costs)}
    assert set(front) == expected
    assert [costs[k][1] for k in front] == sorted(costs[k][1] for k in front)
    for k, by in enumerate(dominators(costs)):
        assert (by is None) == (k in expected)
        assert by is None or by in expected

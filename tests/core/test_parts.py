"""Parts of a range on several threads: each once, errors told, none waited for in vain."""

import threading

import numpy as np
import pytest

from relightcli.core.parts import in_parts, side_by_side


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_every_index_once(threads: int, count: int) -> None:
    done = np.zeros(count, int)

    def work(a: int, b: int) -> None:
        done[a:b] += 1

    in_parts(work, count, threads)
    assert (done == 1).all()


def test_an_error_of_any_part_is_told() -> None:
    def work(a: int, b: int) -> None:
        if a <= 50 < b:
            raise ValueError("part")

    for _ in range(20):
        with pytest.raises(ValueError, match="part"):
            in_parts(work, 100, 2)


def test_parts_within_parts_end() -> None:
    """The inner call's other threads are all waiting for it: it does their work itself."""
    done = np.zeros((8, 8), int)

    def outer(a: int, b: int) -> None:
        for k in range(a, b):

            def inner(c: int, d: int, row: int = k) -> None:
                done[row, c:d] += 1

            in_parts(inner, 8, 2)

    in_parts(outer, 8, 2)
    assert (done == 1).all()


def test_side_by_side() -> None:
    begun = threading.Event()

    def first() -> int:
        assert begun.wait(10.0)  # the other is under way meanwhile
        return 1

    def second() -> str:
        begun.set()
        return "two"

    assert side_by_side(first, second, 2) == (1, "two")
    assert side_by_side(lambda: 1, second, 1) == (1, "two")

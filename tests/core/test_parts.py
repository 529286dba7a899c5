"""Parts of a range on several threads: each once, errors told, none waited for in vain."""

import threading
import time

import numpy as np
import pytest

from relightcli.core.parts import in_order, in_parts, one_blas_thread, side_by_side


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


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order(threads: int) -> None:
    def work(k: int) -> int:
        time.sleep(0.002 * (k % 3))
        return k * k

    assert list(in_order(work, range(23), threads)) == [k * k for k in range(23)]
    assert list(in_order(work, [], threads)) == []


def test_no_more_wait_than_there_are_threads() -> None:
    begun: list[int] = []
    results = in_order(lambda k: begun.append(k), range(50), 3)
    next(results)
    time.sleep(0.05)
    assert len(begun) <= 4  # three and the one that was taken
    results.close()
    time.sleep(0.05)
    assert len(begun) <= 4


def test_an_error_comes_in_its_turn_and_ends_the_rest() -> None:
    begun: list[int] = []

    def work(k: int) -> int:
        begun.append(k)
        if k == 5:
            raise ValueError("item")
        return k

    results, found = in_order(work, range(100), 2), []
    with pytest.raises(ValueError, match="item"):
        found.extend(results)
    assert found == [0, 1, 2, 3, 4]
    assert max(begun) <= 7


def test_blas_keeps_to_one_thread() -> None:
    from threadpoolctl import threadpool_info

    def threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = threads()
    with one_blas_thread():
        assert set(threads()) == {1}
    assert threads() == before

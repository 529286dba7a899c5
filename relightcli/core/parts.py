"""Work on the threads of this process, for kernels that let go of Python's lock."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import TypeVar

import numpy as np

A = TypeVar("A")
B = TypeVar("B")


def in_parts(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """Calls work(start, stop) for parts of range(count), here and on `threads` - 1 others that stay."""
    if threads <= 1:
        if count:
            work(0, count)
        return
    cuts = np.linspace(0, count, 6 * threads + 1).astype(int).tolist()
    parts = iter([(a, b) for a, b in itertools.pairwise(cuts) if b > a])  # a list's iterator is safe to share

    def take() -> None:
        for a, b in parts:
            work(a, b)

    pool = _pool(threads - 1)
    others = [pool.submit(take) for _ in range(threads - 1)]
    try:
        take()
    finally:
        for other in others:
            if not other.cancel():  # one that has not begun is not needed any more
                other.result()


def side_by_side(first: Callable[[], A], second: Callable[[], B], threads: int) -> tuple[A, B]:
    """Both results; with several threads what runs on one in either overlaps with the other."""
    if threads <= 1:
        return first(), second()
    with ThreadPoolExecutor(1) as beside:
        later = beside.submit(second)
        return first(), later.result()


def in_order(work: Callable[[A], B], items: Sequence[A], threads: int) -> Generator[B]:
    """work(item) of every item, in their order; as many as there are threads are in work or wait to be taken."""
    if threads <= 1:
        yield from map(work, items)
        return
    pool, coming = ThreadPoolExecutor(threads), deque[Future[B]]()
    try:
        for item in items:
            if len(coming) == threads:
                yield coming.popleft().result()
            coming.append(pool.submit(work, item))
        while coming:
            yield coming.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def for_each(work: Callable[[A], None], items: Sequence[A], threads: int) -> None:
    """Calls work(item) for every item, several at a time."""
    for _ in in_order(work, items, threads):
        pass


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Products and decompositions inside stay on the thread that asks for them: threads of this file do the rest.

    BLAS's own threads wait for work by spinning, which costs several times the work where matrices are small or others
    use the machine, and sums depend on their number.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


@lru_cache(maxsize=4)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)

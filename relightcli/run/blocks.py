"""The block scheduler: whole blocks to worker processes, local ones or Dask's, finished ones into the store's ledger.

A job knows how to do any one of its blocks and nothing of the others. Blocks are independent, write chunks that no
other block owns, and count as done when the ledger says so. The result therefore depends neither on the number of
workers nor on the order nor on interruptions.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Set
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from queue import SimpleQueue
from types import FrameType
from typing import Any, Protocol

from relightcli.errors import SystemFault
from relightcli.run.accounting import Meter

RETRIES = 2  # new worker pools after one broke without finishing a single block
PATIENCE = 5.0  # seconds that workers get to leave before they are killed
Info = dict[str, Any]


@dataclass(frozen=True)
class Block:
    """A range of receivers, rows or samples of one effect."""

    id: str
    start: int
    stop: int


class Worker(Protocol):
    """What a process keeps between blocks (a ray tracer, open arrays)."""

    def run(self, block: Block) -> Info:
        """Does one block, writes its chunks, returns what it cost and what error it found."""
        ...


class Job(Hashable, Protocol):
    """A small picklable description from which any process can make a worker."""

    def open(self) -> Worker: ...


class Ledger(Protocol):
    @property
    def done(self) -> Set[str]: ...

    def record(self, block_id: str, info: dict[str, Any]) -> None: ...


def split(prefix: str, count: int, size: int) -> list[Block]:
    """Blocks of `size` items, `count` in all, named after what they cover."""
    return [Block(f"{prefix}/{start:09d}", start, min(start + size, count)) for start in range(0, count, size)]


def run_blocks(
    job: Job,
    blocks: Iterable[Block],
    ledger: Ledger,
    *,
    workers: int,
    label: str,
    quiet: bool = False,
    scheduler: str | None = None,
    apart: bool = False,
) -> None:
    """Runs every block that the ledger does not hold yet. Raises what a block raised; what is done stays done.

    scheduler: address of a Dask scheduler, whose workers run the blocks instead of local processes.
    apart: in worker processes always. There linear algebra has one thread, and the same bytes come out everywhere.
    """
    todo = [b for b in blocks if b.id not in ledger.done]
    total = len(todo) + len(ledger.done)
    if not todo:
        return
    with _Progress(label, total, total - len(todo), quiet) as progress:

        def finish(block: Block, info: Info) -> None:
            ledger.record(block.id, info)
            progress.step(info)

        if scheduler is not None:
            from relightcli.run.scheduler import run_on_cluster

            run_on_cluster(scheduler, job, todo, finish, label)
            return
        if not apart and (workers <= 1 or len(todo) == 1):
            for block in todo:
                finish(block, run_one(job, block))
            return
        idle_failures = 0
        while todo:
            before = len(todo)
            try:
                with _pool(max(1, min(workers, len(todo)))) as pool:
                    todo = _drain(pool, job, todo, finish)
            except BrokenProcessPool:
                todo = [b for b in todo if b.id not in ledger.done]
                idle_failures = idle_failures + 1 if len(todo) == before else 0
                if idle_failures > RETRIES:
                    raise SystemFault(
                        f"worker processes of {label} keep dying (killed, or out of memory); "
                        "what is finished is kept: run again with fewer --workers"
                    ) from None


def need_scheduler(address: str | None) -> None:
    """Refuses a Dask scheduler that does not answer, before work goes into anything. Raises InputError, SystemFault."""
    if address is not None:
        from relightcli.run.scheduler import connected

        with connected(address):
            pass


def _drain(pool: Executor, job: Job, todo: list[Block], finish: Callable[[Block, Info], None]) -> list[Block]:
    # A queue, not futures.wait: an interrupt amid its locks would leave one taken, and the pool waiting for it.
    ended: SimpleQueue[Future[Info]] = SimpleQueue()
    try:
        futures = _hand_in(pool, job, todo, ended)
        for _ in range(len(futures)):
            future = ended.get()
            finish(futures[future], future.result())
    except BaseException:
        _end_workers(pool)
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    return []


def _hand_in(
    pool: Executor, job: Job, todo: list[Block], ended: SimpleQueue[Future[Info]]
) -> Mapping[Future[Info], Block]:
    """Submits the blocks. Workers start meanwhile; an interrupt waits until they know that it is not theirs."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        futures = {pool.submit(run_one, job, block): block for block in todo}
        for future in futures:
            future.add_done_callback(ended.put)
        return futures
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _end_workers(pool: Executor) -> None:
    """Asks the workers to leave, and kills those that have not left in time."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + PATIENCE
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))
        if process.exitcode is None:
            process.kill()


def _pool(workers: int) -> ProcessPoolExecutor:
    import multiprocessing

    # One BLAS thread per worker; the variables must stand before the workers import NumPy.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"
    return ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker, initargs=(os.getpid(),)
    )


def _start_worker(parent: int) -> None:
    """A worker leaves interrupts to its parent and does not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # it came blocked
    signal.signal(signal.SIGTERM, _leave_worker)
    # The parent says what went wrong; zarr's event loop would complain about every chunk beside it.
    logging.getLogger("asyncio").disabled = True

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _leave_worker(signum: int, frame: FrameType | None) -> None:
    """Ends a worker at once, in the way of its normal end: libraries' semaphores are given back."""
    from multiprocessing import util

    util._exit_function()  # type: ignore[attr-defined]
    os._exit(1)


_opened: tuple[Job, Worker] | None = None


def run_one(job: Job, block: Block) -> Info:
    """Does one block in this process, which keeps the job open for the next."""
    global _opened
    if _opened is None or _opened[0] != job:
        _opened = None
        _opened = (job, job.open())
    meter = Meter()
    return _opened[1].run(block) | meter.read()


def close_worker() -> None:
    """Forgets what this process keeps between blocks, so that its memory can go."""
    global _opened
    _opened = None


class _Progress:
    """A bar on stderr with rays per second and the time left; nothing where stderr is no terminal."""

    def __init__(self, label: str, total: int, done: int, quiet: bool) -> None:
        self._bar: Any = None
        self._rays = 0.0
        self._start = time.perf_counter()
        if not quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, initial=done, desc=label, unit="block", file=sys.stderr)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def step(self, info: Info) -> None:
        if self._bar is not None:
            self._rays += info.get("rays", 0.0)
            rate = self._rays / (time.perf_counter() - self._start)
            self._bar.set_postfix_str(f"{rate / 1e6:.1f} Mray/s", refresh=False)
            self._bar.update(1)

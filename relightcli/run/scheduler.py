"""Blocks on a Dask cluster: one task a block, which writes its chunks itself and returns only what it cost.

Workers reach the store under the path that it has here. A block whose worker is lost runs again on another; it writes
the same bytes again. A worker does one block at a time, whatever its threads: what it keeps between blocks is one.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from relightcli import __version__
from relightcli.errors import InputError, RelightError, StoreError, SystemFault
from relightcli.run.blocks import Block, Info, Job, run_one

if TYPE_CHECKING:
    from distributed import Client, Future

ANSWER = 10.0  # seconds in which a scheduler has to answer
EMPTY = 60.0  # seconds that a cluster may be without any worker; one that grows by need begins so
LEAVE = 30.0  # seconds that blocks in progress get to end, when a run is given up
POLL = 1.0  # seconds between looks at the cluster while no block ends
KEPT = "what is finished is kept: run the same command again to continue"


def run_on_cluster(
    address: str, job: Job, todo: list[Block], finish: Callable[[Block, Info], None], label: str
) -> None:
    """Runs the blocks and calls `finish` with each as it ends. Raises what a block raised.

    Raises:
        InputError: no address.
        SystemFault: no scheduler, no workers, a block at which one worker after the other dies, another version.
    """
    token = uuid.uuid4().hex
    with connected(address) as client:
        keys = [f"relightcli-{block.id}-{token}" for block in todo]
        futures: dict[str, tuple[Block, Future[Info]]] = {}
        try:
            handed_in = client.map(_task, todo, job=job, token=token, version=__version__, key=keys, pure=False)
            futures = dict(zip(keys, zip(todo, handed_in, strict=True), strict=True))
            del handed_in  # a result is dropped where it lies as soon as it has been read
            ended: SimpleQueue[str] = SimpleQueue()

            def watch(future: Future[Info]) -> None:
                future.add_done_callback(lambda done: ended.put(done.key))

            for _, future in futures.values():
                watch(future)
            last = time.monotonic()
            while futures:
                try:
                    key = ended.get(timeout=POLL)
                except Empty:
                    last = _last_seen(client, address, last)
                    continue
                block, future = futures[key]
                info = _result(future, address, label)
                if info is None:  # its worker was lost after the block, and before anybody asked
                    last = _last_seen(client, address, last)
                    watch(future)
                    continue
                finish(block, info)
                del futures[key], future
                last = time.monotonic()
        except BaseException:
            _give_up(client, [future for _, future in futures.values()], token)
            raise


@contextlib.contextmanager
def connected(address: str) -> Iterator[Client]:
    """A client of the scheduler. Raises InputError for what is no address, SystemFault where nobody answers."""
    try:
        import distributed
    except ImportError:
        raise SystemFault("--scheduler needs Dask, which is not installed: pip install 'relightcli[cluster]'") from None
    # What matters reaches the user as an error of this program.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    failure: RelightError | None = None
    try:
        client = distributed.Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, TimeoutError):
        failure = SystemFault(
            f"--scheduler {address}: no Dask scheduler answers there; expected one that runs, as `dask scheduler` "
            "starts it"
        )
    except (ValueError, TypeError, KeyError) as error:
        failure = InputError(f"--scheduler {address}: expected an address such as tcp://host:8786; {error}")
    if failure is not None:
        gc.collect()  # what is left of the client closes now, not amid the start of the next, which it would block
        raise failure
    try:
        yield client
    finally:
        try:
            client.close(timeout=2.0)
        except Exception:  # a scheduler that has died cannot be taken leave of, and must not be tried again
            client.status = "closed"


def _last_seen(client: Client, address: str, last: float) -> float:
    """Now, if the cluster has any worker. Raises SystemFault where it has had none for too long."""
    try:
        workers = client.scheduler_info(n_workers=0)["n_workers"]
    except Exception as error:  # the library raises whatever its transport does
        raise _lost(address) from error
    if workers:
        return time.monotonic()
    if time.monotonic() - last > EMPTY:
        raise SystemFault(
            f"--scheduler {address}: the cluster has had no workers for {EMPTY:.0f} s; expected at least one, as "
            f"`dask worker {address}` starts it; {KEPT}"
        )
    return last


def _result(future: Future[Info], address: str, label: str) -> Info | None:
    """What a block returned; None if that is not to be had any more, and is being made again."""
    from distributed import KilledWorker

    if future.status == "cancelled":
        raise _lost(address)
    try:
        info: Info = future.result(timeout=POLL)
        return info
    except TimeoutError:
        if future.status == "error":  # the block's own
            raise
        return None
    except KilledWorker as error:
        raise SystemFault(
            f"workers of {label} keep dying at one block (killed, or out of memory; the last was "
            f"{error.last_worker.address}); {KEPT}, with more memory a worker"
        ) from None
    except ModuleNotFoundError as error:
        raise SystemFault(
            f"--scheduler {address}: a worker has no module {error.name}; expected relightcli {__version__} on each"
        ) from error


def _lost(address: str) -> SystemFault:
    return SystemFault(f"--scheduler {address}: the connection to the scheduler is lost; {KEPT}")


def _give_up(client: Client, futures: list[Future[Info]], token: str) -> None:
    """Takes back what has not begun, and waits for the blocks in progress: after this nothing of the run is written."""
    if client.status != "running":  # without their scheduler workers end, too
        return
    with contextlib.suppress(Exception):  # of a scheduler or workers that have died
        client.cancel(futures, force=True)
        deadline = time.monotonic() + LEAVE
        while any(client.run(_abandon, token, on_error="ignore").values()) and time.monotonic() < deadline:
            time.sleep(0.1)


# What follows runs in the workers.

_turn = threading.Lock()
_running = ""
_abandoned: set[str] = set()


def _task(block: Block, job: Job, token: str, version: str) -> Info:
    global _running
    with _turn:
        if version != __version__:
            raise SystemFault(
                f"{_here()}: expected relightcli {version}, as where the command runs, found {__version__}"
            )
        _running = token
        try:
            if token in _abandoned:
                return {}
            return run_one(job, block)
        except StoreError as error:
            raise StoreError(f"{error} ({_here()}; it has to reach the store under the same path)") from None
        finally:
            _running = ""


def _here() -> str:
    from distributed import get_worker

    return f"worker {get_worker().address}"


def _abandon(token: str) -> bool:
    """No further block of a run; whether one is in progress."""
    _abandoned.add(token)
    return _running == token

"""The block scheduler: any number of workers, any interruption, one result; and what goes wrong, told plainly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from relightcli.cli.exits import SYSTEM, exit_code
from relightcli.errors import InputError, SystemFault
from relightcli.run.blocks import Block, close_worker, run_blocks, split
from tests.run.jobs import Broken, Counting, Dying, FailingBesideASleeper, FileLedger


@pytest.fixture(autouse=True)
def _fresh_worker():
    close_worker()
    yield
    close_worker()


def run(job, ledger, blocks, workers):
    run_blocks(job, blocks, ledger, workers=workers, label="test", quiet=True)


def test_split_covers_everything_once():
    blocks = split("v", 10, 4)
    assert [(b.start, b.stop) for b in blocks] == [(0, 4), (4, 8), (8, 10)]
    assert len({b.id for b in blocks}) == 3
    assert sorted(b.id for b in blocks) == [b.id for b in blocks]
    assert split("v", 0, 4) == []


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_every_block_is_done_once(tmp_path, workers):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 13, 2)
    run(Counting(str(tmp_path)), ledger, blocks, workers)
    assert ledger.done == {b.id for b in blocks}
    for b in blocks:
        name = f"{b.start}.out"
        assert (tmp_path / name).read_text() == f"{b.start} {b.stop}\n"
    info = ledger.infos[blocks[0].id]
    assert info["rays"] == 2.0
    assert info["seconds"] >= 0
    assert info["cpu_seconds"] >= 0
    assert info["peak_bytes"] > 1e6


@pytest.mark.parametrize("workers", [1, 2])
def test_apart_means_never_in_this_process(tmp_path, workers):
    """Not even one block that is left: where linear algebra has one thread, it gives the same bytes."""
    run_blocks(
        Counting(str(tmp_path)),
        split("v", 2, 2),
        FileLedger(tmp_path),
        workers=workers,
        label="test",
        quiet=True,
        apart=True,
    )
    opened = (tmp_path / "opened").read_text().split()
    assert len(opened) == 1
    assert opened[0] != str(os.getpid())


def test_what_is_done_is_not_done_again(tmp_path):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 6, 2)
    ledger.record(blocks[1].id, {})
    run(Counting(str(tmp_path)), ledger, blocks, 1)
    assert not (tmp_path / "2.out").exists()
    run(Counting(str(tmp_path)), ledger, blocks, 1)
    assert (tmp_path / "0.out").read_text() == "0 2\n"


def test_a_worker_is_opened_once_per_process(tmp_path):
    ledger = FileLedger(tmp_path)
    run(Counting(str(tmp_path)), ledger, split("v", 8, 1), 1)
    assert len((tmp_path / "opened").read_text().split()) == 1
    run(Counting(str(tmp_path), "other"), FileLedger(tmp_path), split("v", 2, 1), 1)
    assert len((tmp_path / "opened").read_text().split()) == 2


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    "error", [InputError("bad"), OSError(28, "No space left on device", "chunk"), ValueError("bug")]
)
def test_an_error_of_a_block_reaches_the_caller(tmp_path, workers, error):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 5, 1)
    with pytest.raises(type(error)) as caught:
        run(Broken(str(tmp_path), error, 3), ledger, blocks, workers)
    assert str(caught.value) == str(error)
    assert blocks[3].id not in ledger.done
    # What was done stays done, and the rest is done by the next run.
    before = set(ledger.done)
    run(Counting(str(tmp_path)), ledger, blocks, workers)
    assert ledger.done == {b.id for b in blocks}
    assert before <= ledger.done
    if isinstance(error, OSError):
        assert exit_code(caught.value) == (SYSTEM, "chunk: No space left on device")


def test_a_killed_worker_is_replaced(tmp_path):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 8, 1)
    run(Dying(str(tmp_path), 3, once=True), ledger, blocks, 2)
    assert ledger.done == {b.id for b in blocks}
    assert (tmp_path / "died").exists()


def test_workers_that_keep_dying_are_a_system_fault(tmp_path):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 4, 1)
    with pytest.raises(SystemFault, match="keep dying") as caught:
        run(Dying(str(tmp_path), 2, once=False), ledger, blocks, 2)
    assert exit_code(caught.value)[0] == SYSTEM
    assert blocks[2].id not in ledger.done


def test_workers_do_not_outlive_their_parent(tmp_path):
    # The parent is killed: its workers notice within a second or so and go.
    script = (
        "from tests.run.jobs import FileLedger, Sleeping\n"
        "from relightcli.run.blocks import run_blocks, split\n"
        "if __name__ == '__main__':\n"
        f"    run_blocks(Sleeping({str(tmp_path)!r}), split('v', 4, 1), FileLedger({str(tmp_path)!r}),\n"
        "               workers=2, label='t', quiet=True)\n"
    )
    (tmp_path / "main.py").write_text(script)
    root = Path(__file__).parents[2]
    parent = subprocess.Popen([sys.executable, str(tmp_path / "main.py")], env={**os.environ, "PYTHONPATH": str(root)})
    try:
        pids = _wait_for(lambda: [int(p.name[4:]) for p in tmp_path.glob("pid.*")], 2)
    finally:
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + 10
    while any(_alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.05)


def _wait_for(found, count):
    deadline = time.monotonic() + 30
    while len(found()) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found()


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    # A process that nobody has waited for yet is dead all the same.
    return not (state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z")


def test_an_error_does_not_wait_for_the_other_workers(tmp_path):
    # One block fails while another takes a minute: its process is ended.
    start = time.monotonic()
    with pytest.raises(ValueError, match="bug"):
        run(FailingBesideASleeper(str(tmp_path)), FileLedger(tmp_path), split("v", 2, 1), 2)
    assert time.monotonic() - start < 30
    pids = [int(p.name[4:]) for p in tmp_path.glob("pid.*")]
    assert len(pids) == 1
    assert not _alive(pids[0])


def test_interrupt_keeps_what_is_done(tmp_path):
    # In this process an interrupt arrives while the second block runs.
    ledger = FileLedger(tmp_path)
    blocks = split("v", 4, 1)
    with pytest.raises(KeyboardInterrupt):
        run(Broken(str(tmp_path), KeyboardInterrupt(), 1), ledger, blocks, 1)
    assert ledger.done == {blocks[0].id}


def test_block_ids_tell_the_order():
    assert Block("a/000000010", 10, 20).id > Block("a/000000002", 2, 10).id
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

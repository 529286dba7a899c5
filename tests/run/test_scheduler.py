"""Blocks on a real Dask scheduler with two worker processes: as locally, whatever dies."""

from __future__ import annotations

import signal
import sys
import threading
import time

import pytest

from relightcli.cli.exits import BAD_INPUT, SYSTEM, exit_code
from relightcli.errors import InputError, StoreError, SystemFault
from relightcli.run import scheduler
from relightcli.run.blocks import need_scheduler, run_blocks, split
from tests.run.cluster import Cluster
from tests.run.jobs import Broken, Counting, Dying, FileLedger, Sleeping, Slow

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'relightcli[cluster]'")


@pytest.fixture(scope="module")
def _processes(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("cluster"))
    yield cluster
    cluster.close()


@pytest.fixture
def cluster(_processes):
    _processes.heal()
    return _processes


def run(job, ledger, blocks, address):
    run_blocks(job, blocks, ledger, workers=1, label="test", quiet=True, scheduler=address)


def test_every_block_is_done_once_and_what_is_done_is_not_done_again(tmp_path, cluster):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 13, 2)
    ledger.record(blocks[2].id, {})
    run(Counting(str(tmp_path)), ledger, blocks, cluster.address)
    assert ledger.done == {b.id for b in blocks}
    for b in blocks:
        path = tmp_path / f"{b.start}.out"
        assert path.exists() == (b is not blocks[2])
        assert not path.exists() or path.read_text() == f"{b.start} {b.stop}\n"
    assert ledger.infos[blocks[0].id]["rays"] == 2.0
    assert ledger.infos[blocks[0].id]["peak_bytes"] > 1e6


@pytest.mark.parametrize(
    "error", [InputError("bad"), OSError(28, "No space left on device", "chunk"), ValueError("bug")]
)
def test_an_error_of_a_block_reaches_the_caller(tmp_path, cluster, error):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 5, 1)
    with pytest.raises(type(error)) as caught:
        run(Broken(str(tmp_path), error, 3), ledger, blocks, cluster.address)
    assert str(caught.value) == str(error)
    assert blocks[3].id not in ledger.done
    if isinstance(error, OSError):
        assert exit_code(caught.value) == (SYSTEM, "chunk: No space left on device")


def test_a_store_that_a_worker_cannot_read_is_told_with_the_worker(tmp_path, cluster):
    with pytest.raises(StoreError, match=r"damaged .worker tcp://127.0.0.1:"):
        run(Broken(str(tmp_path), StoreError("damaged"), 0), FileLedger(tmp_path), split("v", 2, 1), cluster.address)


def test_another_version_of_the_program_is_refused(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(scheduler, "__version__", "0.0.0")
    with pytest.raises(SystemFault, match=r"expected relightcli 0\.0\.0"):
        run(Counting(str(tmp_path)), FileLedger(tmp_path), split("v", 2, 1), cluster.address)
    assert not list(tmp_path.iterdir())


def test_after_an_interrupt_nothing_is_written(tmp_path, cluster):
    class Interrupting(FileLedger):
        def record(self, block_id, info):
            super().record(block_id, info)
            raise KeyboardInterrupt

    ledger = Interrupting(tmp_path)
    blocks = split("v", 8, 1)
    with pytest.raises(KeyboardInterrupt):
        run(Slow(str(tmp_path)), ledger, blocks, cluster.address)
    after = sorted(p.name for p in tmp_path.iterdir())
    begun, ended = ({n.split(".")[0] for n in after if n.endswith(what)} for what in ("begun", "ended"))
    assert begun == ended
    assert len(begun) < 8
    assert len(ledger.done) == 1
    time.sleep(0.5)  # a block that began now would show
    assert sorted(p.name for p in tmp_path.iterdir()) == after


def test_a_lost_worker_costs_its_blocks_only(tmp_path, cluster):
    ledger = FileLedger(tmp_path)
    blocks = split("v", 8, 1)
    run(Dying(str(tmp_path), 3, once=True), ledger, blocks, cluster.address)
    assert ledger.done == {b.id for b in blocks}
    assert [w.poll() for w in cluster.workers].count(-signal.SIGKILL) == 1


def test_workers_that_keep_dying_and_a_cluster_without_any(tmp_path, cluster, monkeypatch):
    blocks = split("v", 2, 1)
    ledger = FileLedger(tmp_path)
    with pytest.raises(SystemFault, match="keep dying") as caught:
        run(Dying(str(tmp_path), 1, once=False), ledger, blocks, cluster.address)
    assert exit_code(caught.value)[0] == SYSTEM
    assert blocks[1].id not in ledger.done
    monkeypatch.setattr(scheduler, "EMPTY", 0.5)
    with pytest.raises(SystemFault, match="has had no workers"):
        run(Counting(str(tmp_path)), FileLedger(tmp_path), blocks, cluster.address)


@pytest.mark.parametrize(
    ("address", "error", "code"), [("tcp://127.0.0.1:1", SystemFault, SYSTEM), ("nonsense", InputError, BAD_INPUT)]
)
def test_a_scheduler_that_is_not_there(address, error, code, monkeypatch):
    monkeypatch.setattr(scheduler, "ANSWER", 0.5)
    with pytest.raises(error, match=f"--scheduler {address}") as caught:
        need_scheduler(address)
    assert exit_code(caught.value)[0] == code


def test_without_dask_the_user_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SystemFault, match=r"pip install 'relightcli\[cluster\]'"):
        need_scheduler("tcp://127.0.0.1:1")


def test_a_scheduler_that_dies_is_a_system_fault(tmp_path, cluster):
    threading.Timer(1.0, cluster.scheduler.kill).start()
    with pytest.raises(SystemFault, match="connection to the scheduler is lost") as caught:
        run(Sleeping(str(tmp_path)), FileLedger(tmp_path), split("v", 4, 1), cluster.address)
    assert exit_code(caught.value)[0] == SYSTEM

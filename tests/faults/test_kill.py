"""Killed at any moment, the next run goes on, and the store comes out with the same bytes."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time

import pytest

import relight_formats as formats
from tests.faults import harness

KILLS = 6  # `make faults` does hundreds, of every command
DEATH_SECONDS = 5  # a worker looks for its parent twice a second; the rest is for a busy machine


def test_any_number_of_workers_gives_the_same_bytes(undisturbed, folder):
    assert harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)[0] == 0
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)


@pytest.mark.slow
def test_killed_at_random_moments(undisturbed, folder):
    """KILLS times SIGKILL of the program with two workers, every third time of the parent alone, after 0.1 to 1 times
    what a whole run takes."""
    expected = harness.content(undisturbed)
    whole = formats.open_store(undisturbed).summary["seconds"] + 1.0
    store = folder / "t.zarr"
    random_ = random.Random(20)
    finished = 0
    for number in range(KILLS):
        process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
        deadline = time.monotonic() + random_.uniform(0.1, 1.0) * whole
        while time.monotonic() < deadline and process.poll() is None:
            harness.need_whole(store)
            time.sleep(0.05)
        if number % 3 == 2:
            orphans = harness.descendants(process.pid)
            process.kill()
            process.wait()
            # The next run starts at once: what orphans still write does no harm. At the end none may be left.
        else:
            orphans = set()
            harness.kill_group(process)
        if harness.need_whole(store):
            assert harness.content(store) == expected
            shutil.rmtree(store)
            finished += 1
        elif orphans:
            _need_death(orphans)
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    assert code == 0, stderr
    assert harness.content(store) == expected
    assert finished < KILLS  # else nothing was ever interrupted
    assert sorted(p.name for p in folder.iterdir() if p.name.startswith("t.zarr")) == ["t.zarr"]


def _need_death(orphans):
    deadline = time.monotonic() + DEATH_SECONDS
    while left := {pid for pid in orphans if harness.alive(pid)}:
        assert time.monotonic() < deadline, f"processes {left} outlive their parent"
        time.sleep(0.05)


def test_orphans_die_and_the_rerun_does_not_wait_for_them(undisturbed, folder):
    process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    orphans = harness.workers_of(process, 2)
    harness.wait_for_blocks(process, folder / "t.zarr", 1)
    process.kill()
    process.wait()
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    assert code == 0, stderr
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)
    _need_death(orphans)


def test_a_killed_worker_is_replaced(undisturbed, folder):
    process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    victims = harness.workers_of(process, 2)
    harness.wait_for_blocks(process, folder / "t.zarr", 1)
    os.kill(min(victims), signal.SIGKILL)
    code, stderr = harness.finish(process)
    assert code == 0, stderr
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("whole_group", [True, False], ids=["group", "parent"])
def test_interrupted(undisturbed, folder, signum, whole_group):
    """Ctrl-C reaches the whole group, `kill PID` the parent alone: exit code 130, and what is done stays done."""
    store = folder / "t.zarr"
    process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    harness.wait_for_blocks(process, store, 1)
    (os.killpg if whole_group else os.kill)(process.pid, signum)
    code, stderr = harness.finish(process, timeout=30)
    assert code == 130, stderr
    assert "run the same command again" in stderr
    assert not store.exists()
    done = harness.blocks_done(store)
    assert done >= 1
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    assert code == 0, stderr
    assert harness.content(store) == harness.content(undisturbed)
    created = [block["id"] for block in formats.open_store(store).blocks]
    assert len(created) == len(set(created)) > done


def test_interrupted_while_workers_start(folder):
    """Workers that are still importing must not print tracebacks over the message."""
    process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    harness.workers_of(process, 2)
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    code, stderr = harness.finish(process, timeout=30)
    assert code == 130, stderr
    assert stderr.strip().splitlines()[-1].startswith("relightcli: interrupted")


def test_two_writers(undisturbed, folder):
    first = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    harness.wait_for_blocks(first, folder / "t.zarr", 1)
    os.killpg(first.pid, signal.SIGSTOP)  # lest it be done before the others have started
    for more in ((), ("--overwrite",)):
        code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *more)
        assert code == 3
        assert f"another process is writing this store (process {first.pid}" in stderr
    os.killpg(first.pid, signal.SIGCONT)
    code, stderr = harness.finish(first)
    assert code == 0, stderr
    assert harness.content(folder / "t.zarr") == harness.content(undisturbed)

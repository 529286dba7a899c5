"""Runs jobs in child processes that die, and reports what was left.

A program of its own: forking is safe here, where no thread has been started, and not inside pytest.

    python -m tests.formats.crash_driver SCENARIO FOLDER

Prints one JSON object. Scenarios: `fresh`, `overwrite` and `discard` kill the job at its first, second, third, ... call
that changes the file system, then run it to its end; `random` kills it 20 times by SIGKILL at random moments.
"""

from __future__ import annotations

import builtins
import io
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zarr  # noqa: F401  before the first fork, so that children need not load it

from relight_formats import StoreError, begin, open_store, worker_array
from tests.formats.jobs import array_files, run, start, write

CALLS = ("replace", "rename", "unlink", "mkdir", "rmdir", "write", "pwrite", "ftruncate")
"""What changes names or appends in place. Death before a sync leaves what death before the next of these leaves."""
KILLED = 137


def die_before(call: int) -> None:
    """Make this process die, without any clean-up, when it is about to make its `call`-th change to the file system.

    Opening a file for writing counts as well: there it dies just after, with the file empty.
    """
    left = [call]

    def count() -> None:
        left[0] -= 1
        if left[0] < 0:
            os._exit(KILLED)

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        def guarded(*args: Any, **kwargs: Any) -> Any:
            count()
            return function(*args, **kwargs)

        return guarded

    def guarded_open(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        opened = really_open(file, mode, *args, **kwargs)
        if set(mode) & set("wxa+"):
            count()
        return opened

    for name in CALLS:
        setattr(os, name, wrap(getattr(os, name)))
    really_open = io.open
    io.open = builtins.open = guarded_open


def in_child(work: Callable[[], object]) -> int:
    """Exit code of a forked child that does `work`; whatever `work` returns is dropped."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def look(path: Path) -> str:
    """What is under the final name: `absent`, or the factor the store was made with if it is whole, or the problem."""
    if not path.exists():
        return "absent"
    try:
        store = open_store(path)
    except StoreError as error:
        return f"damaged: {error}"
    problems = store.verify()
    return f"damaged: {problems}" if problems else f"factor {store.settings['factor']:g}"


def prepare(path: Path, scenario: str) -> None:
    """What is there before the run that dies: nothing, a finished store, or unfinished work, both of factor 1."""
    if scenario == "overwrite":
        run(path, 1.0)
    elif scenario == "discard":
        writer = start(path, 1.0)
        assert writer is not None
        with writer:
            write(writer, 1.0)


def rerun(path: Path, factor: float) -> bool:
    """The job again, as a user would repeat it: with --overwrite only when it is refused without."""
    try:
        return run(path, factor)
    except StoreError as error:
        if "made with others" not in str(error):
            raise
        return run(path, factor, overwrite=True)


def step(folder: Path, scenario: str) -> list[dict[str, Any]]:
    """Run the job for factor 2 on what `prepare` made and die at every call in turn; then run a job to its end.

    That job is of factor 2 again, except after `discard`: there factor 1, whose unfinished work was being dropped.
    """
    os.fsync = lambda fd: None  # the death of a process loses nothing that was written; syncing only takes time here
    before = folder / "before"
    before.mkdir()
    assert in_child(lambda: prepare(before / "store.zarr", scenario)) == 0
    results = []
    for call in range(10_000):
        place = folder / f"{call}"
        shutil.copytree(before, place)
        path = place / "store.zarr"

        def dying(path: Path = path, call: int = call) -> None:
            die_before(call)
            run(path, 2.0, overwrite=scenario != "fresh")

        def again(path: Path = path) -> None:
            seen: dict[str, Any] = {"after_crash": look(path)}
            seen["worked"] = rerun(path, 1.0 if scenario == "discard" else 2.0)
            seen["at_end"] = look(path)
            (folder / "seen.json").write_text(json.dumps(seen))

        code = in_child(dying)
        assert in_child(again) == 0, f"rerun after death at call {call}"
        seen = json.loads((folder / "seen.json").read_text())
        beside = sorted(entry.name for entry in place.iterdir())
        results.append({"code": code, **seen, "files": array_files(path), "beside": beside})
        shutil.rmtree(place)
        if code == 0:
            return results
    raise AssertionError("the job never ended")


BLOCKS, ROWS, COLUMNS = 40, 100, 500


def long_job(path: Path) -> None:
    """Forty blocks of 200 kB in two arrays; long enough to be hit in the middle of everything."""
    writer = begin(path, "long", settings={}, inputs={}, program="test 1")
    if writer is None:
        return
    with writer:
        import numpy as np

        for name in ("a/first", "a/second"):
            shape = (BLOCKS * ROWS, COLUMNS)
            writer.array(name, shape=shape, dtype="float32", chunks=(ROWS, COLUMNS), dims=("V", "L"))
        for block in range(BLOCKS):
            if f"{block}" in writer.done:
                continue
            data = np.random.default_rng(block).normal(size=(ROWS, COLUMNS)).astype(np.float32)
            for name in ("a/first", "a/second"):
                worker_array(writer.partial_path, name)[block * ROWS : (block + 1) * ROWS] = data
            writer.record(f"{block}", {"seconds": time.monotonic()})
        writer.commit({"finished": time.time()})


def random_kills(folder: Path, kills: int = 20) -> dict[str, Any]:
    started = time.monotonic()
    assert in_child(lambda: long_job(folder / "whole.zarr")) == 0
    whole = time.monotonic() - started
    moments = random.Random(2006)
    stores, landed, resumed = 0, 0, 0
    different = []
    while landed < kills:
        path = folder / f"{stores}.zarr"
        stores += 1
        while True:
            child = os.fork()
            if child == 0:
                long_job(path)
                os._exit(0)
            time.sleep(moments.uniform(0.0, whole))
            if landed < kills:
                os.kill(child, signal.SIGKILL)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            if code == 0:
                break
            assert code == -signal.SIGKILL, code
            landed += 1
            ledger = folder / f"{path.name}.partial" / "ledger.jsonl"
            resumed += ledger.exists() and ledger.stat().st_size > 0
        if array_files(path) != array_files(folder / "whole.zarr"):
            different.append(path.name)

    def verify_all() -> None:
        problems = [open_store(folder / f"{i}.zarr").verify() for i in range(stores)]
        (folder / "problems.json").write_text(json.dumps(problems))

    assert in_child(verify_all) == 0
    return {
        "kills": landed,
        "kills_with_finished_blocks": resumed,
        "stores": stores,
        "different": different,
        "problems": json.loads((folder / "problems.json").read_text()),
        "files": len(array_files(folder / "whole.zarr")),
    }


def main() -> None:
    scenario, folder = sys.argv[1], Path(sys.argv[2])
    if scenario == "random":
        result: Any = random_kills(folder)
    else:
        result = step(folder, scenario)
    print(json.dumps(result))


if __name__ == "__main__":
    main()

"""A Dask scheduler and its workers as processes that a test starts and may kill."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
START_SECONDS = 60  # on a busy machine


class Cluster:
    """Two workers of one thread each, without nannies: who is killed stays dead until `heal`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.scheduler: subprocess.Popen | None = None
        self.workers: list[subprocess.Popen] = []
        self.log = open(folder / "log", "ab")  # noqa: SIM115

    @property
    def address(self) -> str:
        return json.loads(self.file.read_text())["address"]

    def heal(self) -> None:
        """Starts what is not alive."""
        if self.scheduler is None or self.scheduler.poll() is not None:
            self.close()
            self.log = open(self.folder / "log", "ab")  # noqa: SIM115
            self.file.unlink(missing_ok=True)
            self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self.workers = [worker for worker in self.workers if worker.poll() is None]
        while len(self.workers) < 2:
            self.workers.append(
                self._start("worker", "--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--no-dashboard")
            )
        deadline = time.monotonic() + START_SECONDS
        while not self.file.exists():  # workers wait for it too
            assert self.scheduler.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def _start(self, kind: str, *options: str) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", self.file, *options],
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
                "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",  # two workers are soon used up
            },
            cwd=self.folder,  # not where the command runs
            stdout=self.log,
            stderr=self.log,
        )

    def close(self) -> None:
        for process in [*self.workers, *([self.scheduler] if self.scheduler else [])]:
            process.kill()
            process.wait()
        self.workers, self.scheduler = [], None
        self.log.close()

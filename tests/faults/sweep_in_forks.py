"""`relightcli tradeoff` whose commands are forks of this process, not programs: the same records, in less time."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence

from relightcli.adapters.processes import Finished


def sweep(words: list[str]) -> None:
    from relightcli.cli.main import main
    from relightcli.stages import tradeoff_runs

    tradeoff_runs.run_program = _fork
    main(words)


def _fork(command: Sequence[str]) -> Finished:
    parent = os.getpid()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.perf_counter()
        pid = os.fork()
        if pid == 0:
            with contextlib.suppress(BaseException):
                ctypes.CDLL(None).prctl(1, signal.SIGTERM)
                if os.getppid() != parent:
                    os._exit(1)
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
                sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
                from relightcli.cli.main import main

                main(list(command[command.index("relightcli") + 1 :]))
            os._exit(77)
        try:
            _, status, usage = os.wait4(pid, 0)
        except BaseException:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            raise
        out.seek(0)
        err.seek(0)
        code = os.waitstatus_to_exitcode(status)
        took = time.perf_counter() - started
        cpu, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024
        return Finished(code, took, cpu, peak, out.read().decode(), err.read().decode("utf-8", "replace"))

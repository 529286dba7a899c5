"""Commands as forked children of a process that has everything loaded, with something that befalls them on their way.

A child is a process of its own that really dies, writes and fails; only the start of an interpreter is saved. What
befalls it is counted in file operations below one folder: creating or opening for writing, renaming, removing, making
and removing folders. Python reports each of them before it happens (sys.addaudithook).
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_NAMES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")


@dataclass(frozen=True)
class Result:
    """code: exit code, negative for a signal; None: it hung and was killed."""

    code: int | None
    stderr: str
    operations: int
    seconds: float


class Watch:
    """Counts the file operations of this process below `folder`, and calls `act(number, name, path)` before each."""

    def __init__(self, folder: Path, act: Callable[[int, str, str], None]) -> None:
        self.folder, self.act, self.count, self.busy = f"{folder}{os.sep}", act, 0, False
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[object, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if not isinstance(flags, int) or not flags & _WRITING:
                return
        elif event in _NAMES:
            path = arguments[0]
        else:
            return
        if not isinstance(path, str | bytes | os.PathLike) or self.busy:
            return
        name = os.path.abspath(os.fsdecode(path))
        if not name.startswith(self.folder):
            return
        self.count += 1
        self.busy = True
        try:
            self.act(self.count, event, name)
        finally:
            self.busy = False


class Child:
    """A command that runs in a fork of this process."""

    def __init__(
        self,
        folder: Path,
        words: list[str],
        *,
        act: Callable[[int, str, str], None] | None = None,
        watched: Path | None = None,
        before: Callable[[], None] | None = None,
        run: Callable[[list[str]], object] | None = None,
    ) -> None:
        self.reader, self.writer = os.pipe()  # what a command says fits into it
        self.counter = tempfile.TemporaryFile()  # noqa: SIM115
        self.started = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            self._live(folder, words, act, watched or folder, before, run)
        os.close(self.writer)

    def _live(self, folder, words, act, watched, before, run) -> None:  # type: ignore[no-untyped-def]
        """What the child does; never returns."""
        try:
            os.setsid()
            atexit._clear()
            signal.signal(signal.SIGINT, signal.default_int_handler)
            nothing = os.open(os.devnull, os.O_RDWR)
            os.dup2(nothing, 0)
            os.dup2(nothing, 1)
            os.dup2(self.writer, 2)
            sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
            sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
            os.chdir(folder)
            counter = self.counter.fileno()

            def note(number: int, event: str, path: str) -> None:
                os.pwrite(counter, str(number).encode(), 0)
                if act is not None:
                    act(number, event, path)

            Watch(watched, note)
            if before is not None:
                before()
            if run is None:
                from relightcli.cli.main import main as run
            run(words)
            os._exit(0)
        except BaseException as error:
            with contextlib.suppress(BaseException):
                import traceback

                os.write(2, "".join(traceback.format_exception(error)).encode())
        finally:
            os._exit(77)

    def signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def stopped(self, timeout: float) -> bool:
        """Waits until the child has stopped itself (True) or ended (False; `finish` then tells how)."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            try:
                state = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                return False
            if state in "TZ":
                return state == "T"
            time.sleep(0.002)
        return False

    def finish(self, timeout: float) -> Result:
        deadline = self.started + timeout
        code: int | None = None
        while True:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                code = os.waitstatus_to_exitcode(status)
                break
            if time.monotonic() > deadline:
                break
            time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)  # whatever it has left running
        if code is None:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, 0)
        os.set_blocking(self.reader, False)
        text = b""
        with contextlib.suppress(BlockingIOError):
            text = os.read(self.reader, 1 << 16)
        os.close(self.reader)
        self.counter.seek(0)
        count = self.counter.read()
        self.counter.close()
        return Result(code, text.decode("utf-8", "replace"), int(count or 0), time.monotonic() - self.started)


def dies(at: int, number: int) -> Callable[[int, str, str], None]:
    """Signal `number` to itself before file operation `at`."""

    def act(count: int, event: str, path: str) -> None:
        if count == at:
            os.kill(os.getpid(), number)

    return act


def fails(at: int, code: int) -> Callable[[int, str, str], None]:
    """From operation `at` on nothing can be created (a full disk), or changed at all (one that became read-only)."""
    import errno

    def act(count: int, event: str, path: str) -> None:
        if count >= at and (event in ("open", "os.mkdir") or code == errno.EROFS):
            raise OSError(code, os.strerror(code), path)

    return act


def calls(at: int, what: Callable[[], None]) -> Callable[[int, str, str], None]:
    """Calls `what` before file operation `at`."""

    def act(count: int, event: str, path: str) -> None:
        if count == at:
            what()

    return act


def one_thread(module: str) -> None:
    """Starts this program, a module, again unless NumPy's libraries have no threads: forks would wait for them. Nor has
    OpenImageIO, from here on.

    Before its first picture: where OpenEXR's pool has threads already, a fork that is the first to want none joins
    those of its parent. They are not there: it fails, or waits for ever for a new thread that has got the place of one.
    """
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    if missing := [name for name in names if os.environ.get(name) != "1"]:
        os.environ |= dict.fromkeys(missing, "1")
        os.execv(sys.executable, [sys.executable, "-m", module, *sys.argv[1:]])
    from relightcli.adapters.oiio import load_oiio

    load_oiio().attribute("threads", 1)
    load_oiio().attribute("exr_threads", -1)

"""The program as a process to be harmed: start it, hurt it, and compare what it leaves on disk."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import relight_formats as formats

BOUNCES = ("--bounces", "1", "--bounce-resolution", "8")
PRECOMPUTE = ("precompute", "scene.toml", "--light-resolution", "256", "--refine", "8", "--no-subdivide", *BOUNCES)
WORKERS = ("--workers", "2")
# What tells when and how fast a store was made; everything else must be the same bytes after any interruption.
TIMED = ("zarr.json", "ledger/zarr.json")
_started: list[subprocess.Popen[str]] = []


def start(folder: Path, *arguments: object, before=None, first: str = "") -> subprocess.Popen[str]:
    """Starts `relightcli ...` in `folder`, leader of a process group of its own.

    before: called in the child before the program. first: Python that the program runs first.
    """
    program = ["-c", f"{first}\nfrom relightcli.cli.main import main\nmain()"] if first else ["-m", "relightcli"]
    process = subprocess.Popen(
        [sys.executable, *program, *map(str, arguments)],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=before,
    )
    _started.append(process)
    return process


def clear() -> None:
    """Ends what a test has left running."""
    while _started:
        process = _started.pop()
        kill_group(process)
        process.stdout.close()
        process.stderr.close()


def finish(process: subprocess.Popen[str], timeout: float = 120) -> tuple[int, str]:
    """Exit code and stderr. Whatever happened, a traceback is a defect."""
    try:
        _, stderr = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        kill_group(process)
        raise
    assert "Traceback" not in stderr, stderr
    assert "internal error" not in stderr, stderr
    return process.returncode, stderr


def run(folder: Path, *arguments: object, before=None, first: str = "") -> tuple[int, str]:
    return finish(start(folder, *arguments, before=before, first=first))


def kill_group(process: subprocess.Popen[str]) -> None:
    """Kills what is left of the group: none where the program has finished and been waited for."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def descendants(pid: int) -> set[int]:
    """Processes below `pid`, from /proc."""
    parent = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if fields[0] != "Z":
                parent[int(entry.name)] = int(fields[1])
    found: set[int] = set()
    while more := {p for p, above in parent.items() if (above == pid or above in found) and p not in found}:
        found |= more
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def workers_of(process: subprocess.Popen[str], wanted: int) -> set[int]:
    """The block workers (not multiprocessing's resource tracker), once `wanted` of them have started."""
    while True:
        assert process.poll() is None, process.communicate()[1]
        found = set()
        for pid in descendants(process.pid):
            try:
                command = Path(f"/proc/{pid}/cmdline").read_bytes()
            except OSError:
                continue
            if b"spawn_main" in command:
                found.add(pid)
        if len(found) >= wanted:
            return found
        time.sleep(0.01)


def blocks_done(store: Path) -> int:
    partial = store.with_name(store.name + ".partial")
    try:
        return (partial / "ledger.jsonl").read_bytes().count(b"\n")
    except OSError:
        return 0


def wait_for_blocks(process: subprocess.Popen[str], store: Path, count: int) -> None:
    while blocks_done(store) < count:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.005)


def content(store: Path) -> dict[str, str]:
    """Digest of every file of a finished store but those that hold times, and the store's own fingerprint."""
    files = {
        path.relative_to(store).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(store.rglob("*"))
        if path.is_file() and path.relative_to(store).as_posix() not in TIMED
    }
    return {**files, "fingerprint": formats.open_store(store).fingerprint}


def need_whole(store: Path) -> bool:
    """Under its final name a store is complete or not there; whether it is there."""
    if not store.exists():
        return False
    opened = formats.open_store(store)
    assert opened.verify() == []
    return True


def drop_root_powers() -> None:
    """For a child process: file permissions hold for root too (CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH go)."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (1, 2):
            if libc.prctl(24, capability, 0, 0, 0) != 0:  # PR_CAPBSET_DROP
                os._exit(99)


def limit_file_size(limit: int):
    """For a child process: files beyond `limit` bytes cannot be written, as on a full disk."""

    def apply() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return apply


def rewrite_header(store: Path, **changes: object) -> None:
    """Change fields of a store's header, with a digest that fits: as another program would have written it."""
    from relight_formats.header import KEY, write_root

    attributes = json.loads((store / "zarr.json").read_text())["attributes"]
    header = {**attributes.pop(KEY), **changes}
    write_root(store, header, attributes)


def mount_small(folder: Path, size: int) -> None:
    """For a child process: a disk of `size` bytes of its own at `folder`. Where that is refused it ends with 98."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(0x00020000) != 0:  # CLONE_NEWNS
        os._exit(98)
    if libc.mount(b"none", b"/", None, (1 << 18) | (1 << 14), None) != 0:  # MS_PRIVATE | MS_REC
        os._exit(98)
    if libc.mount(b"tmpfs", bytes(folder), b"tmpfs", 0, f"size={size}".encode()) != 0:
        os._exit(98)


def grow(folder: Path, size: int) -> None:
    """The same disk with more room."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mount(b"tmpfs", bytes(folder), b"tmpfs", 32, f"size={size}".encode()) == 0  # MS_REMOUNT

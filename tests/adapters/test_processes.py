"""A program of its own: what it took, and that nothing of it is left."""

import ast
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from relightcli.adapters.processes import run_program


def test_time_memory_output_and_code():
    code = "import sys, time; x = bytearray(200_000_000); print('out'); print('err', file=sys.stderr); time.sleep(0.3)"
    # The kernel counts the caller's memory at the fork into the peak: a small caller.
    caller = (
        "import sys; from relightcli.adapters.processes import run_program\n"
        f"done = run_program([sys.executable, '-c', {code + '; sys.exit(3)'!r}])\n"
        "print([done.code, done.stdout, done.stderr, done.seconds, done.peak_bytes, done.cpu_seconds])\n"
    )
    told = subprocess.run([sys.executable, "-c", caller], capture_output=True, text=True, check=True).stdout
    code, out, err, seconds, peak_bytes, cpu_seconds = ast.literal_eval(told)
    assert (code, out, err) == (3, "out\n", "err\n")
    assert 0.3 < seconds < 30  # nothing but starting Python on a busy machine
    # The array is touched in full; an interpreter takes some ten MB more.
    assert 200e6 < peak_bytes < 400e6
    assert cpu_seconds > 0


def test_an_interrupt_ends_the_program_too():
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    started = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        run_program([sys.executable, "-c", "import time; time.sleep(60)"])
    assert time.perf_counter() - started < 30


@pytest.mark.skipif(sys.platform != "linux", reason="needs PR_SET_PDEATHSIG")
def test_a_killed_caller_leaves_no_program():
    # The program's pid goes through the caller's own stdout, which the program does not have: hence a file descriptor.
    read, write = os.pipe()
    inner = f"import os, time; os.write({write}, str(os.getpid()).encode()); time.sleep(60)"
    outer = (
        "import os, sys; from relightcli.adapters import processes as p; import subprocess;"
        "real = subprocess.Popen;"
        f"subprocess.Popen = lambda *a, **k: real(*a, pass_fds=({write},), **k);"
        f"p.run_program([sys.executable, '-c', {inner!r}])"
    )
    with subprocess.Popen([sys.executable, "-c", outer], pass_fds=(write,)) as caller:
        pid = int(os.read(read, 20))
        caller.kill()
    os.close(read)
    os.close(write)
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        try:
            with open(f"/proc/{pid}/stat") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":  # ended, and not collected yet
                    return
        except FileNotFoundError:
            return
        time.sleep(0.05)
    pytest.fail("the program outlived its caller")

"""Memory of a process is its own, and not that of the program which started it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from relightcli.run.accounting import Account, peak_bytes

SMALL = "from relightcli.run.accounting import peak_bytes; print(peak_bytes())"
LARGE = f"""
import subprocess, sys
block = b"x" * 400_000_000
print(subprocess.run([sys.executable, "-c", {SMALL!r}], capture_output=True, text=True, check=True).stdout)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere getrusage is all there is")
def test_memory_of_the_program_that_started_a_process_is_not_its_own():
    found = subprocess.run([sys.executable, "-c", LARGE], capture_output=True, text=True, check=True)
    assert 1e6 < float(found.stdout) < 2e8


def test_memory_once_taken_is_remembered():
    account = Account()
    with account.step("large"):
        block = b"x" * 150_000_000
        del block
    assert account.steps["large"]["peak_bytes"] >= 150_000_000
    assert peak_bytes() >= 150_000_000

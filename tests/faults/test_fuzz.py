"""A sample of the long run (`make fuzz`): parsers on changed files, by Hypothesis, and by the run itself."""

from __future__ import annotations

import os
import random
import tempfile
import threading
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relightcli.errors import InputError
from tests.faults import fuzz

SAMPLED = ("scene", "keyframes", "BVH", "PLY", "GLB", "picture .exr", "store", "description")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    return folder, {t.name: t for t in fuzz.all_targets(folder)}


@pytest.mark.parametrize("name", SAMPLED)
def test_changed_files_are_read_or_refused(places, name):
    folder, targets = places

    @settings(max_examples=30, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(rng=st.randoms(use_true_random=False))
    def check(rng: random.Random) -> None:
        assert fuzz.attempt(targets[name], folder, rng) == ""

    check()


def test_what_a_parser_must_not_do_is_found(tmp_path):
    """Other errors, endless loops, and the death of the process."""

    def read(path):
        kind = path.read_bytes()[:1]
        if kind == b"e":
            raise KeyError("e")
        if kind == b"l":
            while True:
                time.perf_counter()
        if kind == b"m":
            return bytes(4 << 30)
        raise InputError("refused")

    def once(first):
        target = fuzz.Target("t", ".t", (first * 8,), read)
        return fuzz.attempt(target, tmp_path, Unchanged())

    assert once(b"e").startswith("KeyError")
    assert once(b"i") == ""
    old, fuzz.SECONDS = fuzz.SECONDS, 0.2
    try:
        assert "takes more than 0.2 s" in once(b"l")
    finally:
        fuzz.SECONDS = old


@pytest.mark.parametrize("kind", ["waits", "computes"])
def test_a_fork_that_does_not_end_is_told_with_the_place(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(fuzz, "PATIENCE", 0.3)
    # An endless loop that no exception leaves, as one in a library.
    monkeypatch.setattr(fuzz.signal, "setitimer", lambda *args: None)

    def read(path):
        if kind == "waits":
            threading.Event().wait()
        while True:
            time.perf_counter()

    target = fuzz.Target("t", ".t", (b"12345678",), read)
    with tempfile.TemporaryFile() as told, tempfile.TemporaryFile() as stacks:
        pid = os.fork()
        if pid == 0:
            fuzz._slice(target, tmp_path, 0, 0, time.monotonic(), told.fileno(), stacks.fileno())
            os._exit(0)
        status, late = fuzz._wait(pid, time.monotonic())
        stacks.seek(0)
        where = fuzz._where(stacks.read().decode())
    assert status == 9
    assert late == f"{kind} without an end"
    assert "test_fuzz.py" in where
    assert " read" in where


class Unchanged(random.Random):
    """Picks the first of everything, and changes nothing."""

    def randint(self, a, b):
        return 0

    def choice(self, seq):
        return seq[0]

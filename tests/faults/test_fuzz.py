"""A sample of the long run (`make fuzz`): parsers on changed files, by Hypothesis, and by the run itself."""

from __future__ import annotations

import random
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


class Unchanged(random.Random):
    """Picks the first of everything, and changes nothing."""

    def randint(self, a, b):
        return 0

    def choice(self, seq):
        return seq[0]

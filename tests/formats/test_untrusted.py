"""Stores from strangers that ask for more memory than they hold: refused from what they say, before it is allocated."""

from __future__ import annotations

import json
import resource

import google_crc32c
import numpy as np
import pytest
from numcodecs import Blosc, Zstd

from relight_formats import StoreError, begin, open_store
from relight_formats.chunks import unpacked_bytes
from relight_formats.header import DOCUMENT_LIMIT

BOMB = 1 << 28  # bytes: what the chunk unpacks to; it is declared as 8 kB


@pytest.fixture(params=["lz4", "zstd", "zstd_shuffled"])
def store(tmp_path, request):
    with begin(tmp_path / "s.zarr", "samples", settings={}, inputs={}, program="p") as writer:
        writer.put("values", np.arange(1024.0), dims=("a",), codec=request.param)
        writer.commit({})
    return tmp_path / "s.zarr"


def test_a_chunk_that_unpacks_to_more_than_it_holds(store):
    zeros = np.zeros(BOMB, np.uint8)
    codecs = json.loads((store / "values" / "zarr.json").read_text())["codecs"]
    packed = (Zstd(level=3) if codecs[1]["name"] == "zstd" else Blosc("lz4", 5, Blosc.SHUFFLE)).encode(zeros)
    (store / "values" / "c.0").write_bytes(packed + google_crc32c.value(bytes(packed)).to_bytes(4, "little"))
    del zeros
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    opened = open_store(store)
    with pytest.raises(StoreError, match=f"unpacks to {BOMB} bytes where 8192 are expected"):
        opened.read("values")
    (problem,) = opened.verify()
    assert "unpacks to" in problem
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < BOMB / 4


@pytest.mark.parametrize("size", [0, 1, 255, 256, 300, 65_791, 65_792, 1 << 20])
def test_what_a_chunk_says_of_itself(size):
    """Every width of zstd's field for the size: 1, 2 (from 256 on) and 4 bytes; and blosc's."""
    data = np.random.default_rng(size).bytes(size)
    assert unpacked_bytes(Zstd(level=3).encode(data), "zstd") == size
    if size:
        assert unpacked_bytes(Blosc("lz4").encode(data), "blosc") == size


def test_a_chunk_that_does_not_say(store):
    for data in (b"", b"12345", bytes(40)):
        assert unpacked_bytes(data, "zstd") is None
    assert unpacked_bytes(b"12345", "blosc") is None


def test_metadata_without_end(store):
    with open(store / "values" / "zarr.json", "r+b") as file:
        file.truncate(DOCUMENT_LIMIT + 1)  # takes no room on the disk
    with pytest.raises(StoreError, match=r"at most 256 MiB of metadata"):
        open_store(store)

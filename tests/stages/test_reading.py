"""What a picture reads of its store: every chunk at most once, and none of receivers that it does not show."""

from __future__ import annotations

import collections

import numpy as np
import pytest

import relight_formats as formats
from relight_formats import chunks
from relightcli.adapters.images import read_image
from relightcli.scene.model import Camera
from relightcli.stages import lighting
from relightcli.stages.relight import Config, relight
from tests.core.shade.skies import smooth_map
from tests.core.transport.scenes import sphere
from tests.stages.scene_files import make_store, write_scene


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    parts = {"seen": sphere(0.5, (0, 0, 0), rings=10), "away": sphere(0.5, (40, 0, 0), rings=16)}
    camera = Camera("main", (0, 0.5, 3), (0, 0, 0), fov=30, size=(32, 24))
    scene = write_scene(tmp_path_factory.mktemp("reading"), parts, [camera], {"sky": smooth_map()}, True)
    return make_store(scene, light_resolution=128, effects="direct,shadows", subdivide=False)


@pytest.fixture
def reads(monkeypatch):
    """How often each chunk file was read."""
    count: collections.Counter[str] = collections.Counter()
    checked = chunks._checked_chunk

    def counted(root, key, expected):
        count[key] += 1
        return checked(root, key, expected)

    monkeypatch.setattr(chunks, "_checked_chunk", counted)
    return count


def picture(store, output):
    relight(Config(store=store, output=str(output), env="sky", quiet=True))
    return read_image(output).pixels


def test_a_picture_reads_no_chunk_twice(store, tmp_path, reads):
    picture(store, tmp_path / "a.exr")
    assert set(reads.values()) == {1}
    assert not any(name.startswith("source/") for name in reads)


def test_of_a_store_larger_than_memory_only_what_the_camera_sees(store, tmp_path, reads, monkeypatch):
    expected = picture(store, tmp_path / "a.exr")
    reads.clear()
    monkeypatch.setattr(lighting, "IN_MEMORY", 0)
    np.testing.assert_array_equal(picture(store, tmp_path / "b.exr"), expected)
    seen = dict(reads)
    of_bits = {name for name in seen if name.startswith("visibility/bits/")}
    opened = formats.open_store(store)
    of_receiver = opened.read("receivers/object")
    size = opened.layouts["visibility/bits"].chunks[0]
    showing = {n for n in range(-(-len(of_receiver) // size)) if (of_receiver[n * size : (n + 1) * size] == 0).any()}
    assert opened.layouts["visibility/bits"].chunk_count > len(showing)
    assert of_bits <= {f"visibility/bits/c.{n}.0.0.0" for n in showing}
    assert set(seen.values()) == {1}

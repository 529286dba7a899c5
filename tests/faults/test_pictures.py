"""Pictures are there whole or not at all; the reference's samples survive being killed."""

from __future__ import annotations

import fcntl

import pytest

from relightcli.adapters.files import write_atomic
from tests.faults import harness

FRAMES = "format = 1\nframes = 6\n[[key]]\nframe = 1\nenv_rotate = 0\n[[key]]\nframe = 7\nenv_rotate = 360\n"


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["turn.##.exr", "turn.##.ply"])
def test_killed_while_writing_a_sequence(finished, pattern):
    """Whatever stands under a frame's name is the old file or the whole new one."""
    (finished / "frames.toml").write_text(FRAMES)
    arguments = ("relight", "t.zarr", "--frames", "frames.toml", "-o", pattern)
    assert harness.run(finished, *arguments)[0] == 0
    names = [pattern.replace("##", f"{k:02d}") for k in range(1, 7)]
    expected = {name: (finished / name).read_bytes() for name in names}

    def content(name: str) -> bytes | None:
        return (finished / name).read_bytes() if (finished / name).exists() else None

    for round_ in range(4):
        old = b"old" if round_ % 2 else None
        for name in names:
            (finished / name).unlink() if old is None else (finished / name).write_bytes(old)
        process = harness.start(finished, *arguments)
        ended = None
        while content(names[round_]) != expected[names[round_]]:  # killed with that many frames before it
            assert ended is None, process.communicate()[1]
            ended = process.poll()
        harness.kill_group(process)
        assert all(content(name) in (expected[name], old) for name in names)
        for name in names:
            (finished / name).write_bytes(b"old")


def test_what_killed_writers_left_goes_with_the_next_picture(tmp_path):
    """Their temporary files, but none that a living writer has locked, and nothing of other names."""
    left, held, others = tmp_path / ".a.exr.1.partial", tmp_path / ".a.exr.2.partial", tmp_path / ".a.exr.b.partial"
    for path in (left, held, others):
        path.write_bytes(b"half")
    with open(held, "rb") as living:
        fcntl.flock(living.fileno(), fcntl.LOCK_EX)
        write_atomic(tmp_path / "a.exr", b"whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == [held.name, others.name, "a.exr"]
    write_atomic(tmp_path / "a.exr", b"whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == [others.name, "a.exr"]


def test_two_relights_at_once(finished):
    """To one name: either picture, whole. To two: both."""
    first = harness.start(finished, "relight", "t.zarr", "-o", "same.exr", "--env-rotate", 0)
    second = harness.start(finished, "relight", "t.zarr", "-o", "same.exr", "--env-rotate", 90)
    other = harness.start(finished, "relight", "t.zarr", "-o", "other.exr", "--env-rotate", 0)
    assert [harness.finish(p)[0] for p in (first, second, other)] == [0, 0, 0]
    assert harness.run(finished, "relight", "t.zarr", "-o", "turned.exr", "--env-rotate", 90)[0] == 0
    same = (finished / "same.exr").read_bytes()
    assert same in ((finished / "other.exr").read_bytes(), (finished / "turned.exr").read_bytes())


WIDE = "[cameras.wide]\neye = [0, 1.5, 4]\ntarget = [0, 0.5, 0]\nsize = [100, 60]\n"
REFERENCE = ("relight", "scene.toml", "--reference", "--camera", "wide", "--spp", 256, "--workers", 1)
# Blocks of two rows in place of one block for the whole picture.
SMALL_BLOCKS = "import relightcli.stages.reference as reference\nreference.PATHS_PER_BLOCK = 51_200"


def test_reference_goes_on_where_it_was_killed(folder):
    with open(folder / "scene.toml", "a") as file:
        file.write(WIDE)
    assert harness.run(folder, *REFERENCE, "-o", "whole.exr")[0] == 0
    samples = folder / "killed.exr.samples"
    for count in (1, 5, 9):
        process = harness.start(folder, *REFERENCE, "-o", "killed.exr", first=SMALL_BLOCKS)
        harness.wait_for_blocks(process, samples, count)
        harness.kill_group(process)
        assert not (folder / "killed.exr").exists()
    code, stderr = harness.run(folder, *REFERENCE, "-o", "killed.exr", "--seed", 1, first=SMALL_BLOCKS)
    assert code == 3
    assert "setting seed: 0 there, 1 asked for" in stderr
    code, stderr = harness.run(folder, *REFERENCE, "-o", "killed.exr", first=SMALL_BLOCKS)
    assert code == 0, stderr
    assert (folder / "killed.exr").read_bytes() == (folder / "whole.exr").read_bytes()
    assert [p.name for p in folder.iterdir() if "samples" in p.name] == []


def test_reference_refuses_samples_of_another_mesh(folder):
    with open(folder / "scene.toml", "a") as file:
        file.write(WIDE)
    process = harness.start(folder, *REFERENCE, "-o", "out.exr", first=SMALL_BLOCKS)
    harness.wait_for_blocks(process, folder / "out.exr.samples", 1)
    harness.kill_group(process)
    with open(folder / "ball.obj", "a") as file:
        file.write("# changed\n")
    code, stderr = harness.run(folder, *REFERENCE, "-o", "out.exr", first=SMALL_BLOCKS)
    assert code == 3
    assert "input scene" in stderr

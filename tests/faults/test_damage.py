"""Stores that were damaged, exchanged, or made from something else: code 3, and the message says what."""

from __future__ import annotations

import json
import os
import shutil

import pytest

from relightcli.cli.main import run
from relightcli.stages import prepare
from tests.faults import harness

RELIGHT = ("relight", "t.zarr", "-o", "out.exr", "-q")


@pytest.fixture
def here(finished, monkeypatch):
    monkeypatch.chdir(finished)
    return finished


def call(capsys, *arguments):
    """Exit code and stderr of a command that runs in this process."""
    code = run([str(a) for a in arguments])
    stderr = capsys.readouterr().err
    assert "Traceback" not in stderr
    assert "internal error" not in stderr, stderr
    return code, stderr


def files_of(store):
    return sorted(p for p in store.rglob("*") if p.is_file())


def array_of(path, store):
    """What a message about a file has to name: its array or group, or the root metadata."""
    return path.relative_to(store).parent.as_posix() if path.parent != store else path.name


def flip(data):
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]


@pytest.mark.parametrize(
    "harm",
    [flip, lambda data: data[:-1], lambda data: b"", lambda data: None],
    ids=["flipped", "cut", "emptied", "deleted"],
)
def test_every_file_is_guarded(here, capsys, harm):
    """`inspect --verify` finds damage in any file. `relight` either finds it or never needed the file: then the picture
    is the same."""
    assert call(capsys, *RELIGHT)[0] == 0
    good = (here / "out.exr").read_bytes()
    used = set()
    changed_root = harm(b'{"a": 1}\n') != b'{"a": 1}'
    store = here / "t.zarr"
    for path in files_of(store):
        original = path.read_bytes()
        changed = harm(original)
        path.unlink() if changed is None else path.write_bytes(changed)
        name = path.relative_to(store).as_posix()
        code, stderr = call(capsys, "inspect", "t.zarr", "--verify", "-q")
        assert code == 3, name
        code = run(["inspect", "t.zarr", "--verify"])
        shown = capsys.readouterr()
        assert code == 3, name
        # The root's absence leaves a folder that is no store at all.
        assert array_of(path, store) in shown.out + shown.err, name
        (here / "out.exr").unlink()
        code, stderr = call(capsys, *RELIGHT)
        assert code in (0, 3), (name, stderr)
        if code == 3:
            used.add(array_of(path, store))
            assert array_of(path, store) in stderr, name
            assert not (here / "out.exr").exists()
        else:
            assert (here / "out.exr").read_bytes() == good
        path.write_bytes(original)
        (here / "out.exr").write_bytes(good)
    # The root's last byte is a line's end; without it the document still reads the same.
    needed = {"ledger", "visibility/bits", "mesh/position", "receivers/normal"}
    assert needed | ({"zarr.json"} if changed_root else set()) <= used
    assert call(capsys, "inspect", "t.zarr", "--verify")[0] == 0


def test_files_that_do_not_belong(here, capsys):
    (here / "t.zarr" / "visibility" / "notes.txt").write_text("hello")
    assert run(["inspect", "t.zarr", "--verify"]) == 3
    assert "visibility/notes.txt" in capsys.readouterr().out


def test_exchanged_chunks(here, capsys):
    folder = here / "t.zarr" / "visibility" / "bits"
    first, second = folder / "c.0.0.0.0", folder / "c.1.0.0.0"
    one, two = first.read_bytes(), second.read_bytes()
    assert one != two
    first.write_bytes(two)
    second.write_bytes(one)
    assert run(["inspect", "t.zarr", "--verify"]) == 3
    assert "visibility/bits" in capsys.readouterr().out


@pytest.mark.parametrize("version", [0, 2, "1", None])
def test_another_version(here, capsys, version):
    root = here / "t.zarr" / "zarr.json"
    document = json.loads(root.read_text())
    document["attributes"]["relight"]["format"] = version
    root.write_text(json.dumps(document))
    for arguments in (RELIGHT, ("inspect", "t.zarr"), (*harness.PRECOMPUTE, "-o", "t.zarr")):
        code, stderr = call(capsys, *arguments)
        assert code == 3, arguments
        assert "format" in stderr
        assert repr(version) in stderr or json.dumps(version) in stderr


def test_rerun_of_a_finished_store(here, capsys):
    store = here / "t.zarr"
    old = 1_000_000_000
    for path in files_of(store):
        os.utime(path, (old, old))
    before = harness.content(store)
    code, stderr = call(capsys, *harness.PRECOMPUTE, "-o", "t.zarr")
    assert code == 0
    assert "t.zarr is up to date" in stderr
    assert harness.content(store) == before
    assert (store / "zarr.json").stat().st_mtime > old  # for Make
    assert all(p.stat().st_mtime == old for p in files_of(store) if p != store / "zarr.json")
    assert run([*harness.PRECOMPUTE, "-o", "t.zarr", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "up to date"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("--seed", "1"), "seed: 0 there, 1 asked for"),
        (("--light-resolution", "128"), "light_resolution: 256 there, 128 asked for"),
        (("--bounces", "0", "--receivers", "pixels:main"), 'receivers: "vertices" there, "pixels:main" asked for'),
        ("ball.obj", "input ball.obj"),
        ("scene.toml", "input scene.toml"),
    ],
    ids=["seed", "resolution", "receivers", "mesh", "scene"],
)
def test_other_inputs_or_settings(here, capsys, change, named):
    arguments = [*harness.PRECOMPUTE, "-o", "t.zarr"]
    if isinstance(change, tuple):
        arguments += change
    else:
        with open(here / change, "a") as file:
            file.write("\n# changed\n")
    before = harness.content(here / "t.zarr")
    code, stderr = call(capsys, *arguments)
    assert code == 3
    assert named in stderr
    assert "--overwrite" in stderr
    assert harness.content(here / "t.zarr") == before
    assert not (here / "t.zarr.partial").exists()


def test_overwrite_replaces(here, capsys):
    before = harness.content(here / "t.zarr")
    arguments = [*harness.PRECOMPUTE, "-o", "t.zarr", "--light-resolution", "16", "--refine", "4"]
    assert call(capsys, *arguments)[0] == 3
    assert call(capsys, *arguments, "--overwrite", "--workers", "1")[0] == 0
    assert harness.content(here / "t.zarr") != before
    assert call(capsys, *arguments)[0] == 0
    assert [p.name for p in here.iterdir() if p.name.startswith("t.zarr")] == ["t.zarr"]


@pytest.mark.parametrize("changed", ["scene.toml", "ball.obj"])
def test_an_input_changed_while_work_was_interrupted(folder, changed):
    process = harness.start(folder, *harness.PRECOMPUTE, "-o", "t.zarr", *harness.WORKERS)
    harness.wait_for_blocks(process, folder / "t.zarr", 1)
    harness.kill_group(process)
    with open(folder / changed, "a") as file:
        file.write("\n# changed\n")
    code, stderr = harness.run(folder, *harness.PRECOMPUTE, "-o", "t.zarr")
    assert code == 3
    assert f"unfinished work is there, made with others: input {changed}" in stderr
    assert not (folder / "t.zarr").exists()


@pytest.mark.parametrize("changed", ["scene.toml", "ball.obj"])
def test_an_input_changed_while_it_was_read(folder, monkeypatch, capsys, changed):
    """What was read and the fingerprint of what is there now do not belong together: nothing is begun."""
    known = prepare.build_geometry

    def build(scene):
        geometry = known(scene)
        with open(folder / changed, "a") as file:
            file.write("# changed\n")
        return geometry

    monkeypatch.chdir(folder)
    monkeypatch.setattr(prepare, "build_geometry", build)
    code, stderr = call(capsys, *harness.PRECOMPUTE, "-o", "u.zarr")
    assert code == 2
    assert f"{changed}: was changed while it was read" in stderr
    assert [p.name for p in folder.iterdir() if p.name.startswith("u.zarr")] == []


def test_what_is_no_store_is_never_touched(here, capsys):
    (here / "folder").mkdir()
    (here / "folder" / "thesis.txt").write_text("years of work")
    (here / "file.zarr").write_text("years of work")
    for output in ("folder", "file.zarr"):
        for more in ((), ("--overwrite",)):
            assert call(capsys, *harness.PRECOMPUTE, "-o", output, *more)[0] == 3
    assert (here / "folder" / "thesis.txt").read_text() == (here / "file.zarr").read_text() == "years of work"


def test_a_partial_store_is_not_taken_for_a_finished_one(here, capsys):
    shutil.move(here / "t.zarr", here / "t.zarr.partial")
    for name in ("t.zarr", "t.zarr.partial"):
        code, stderr = call(capsys, "relight", name, "-o", "out.exr")
        assert code == 3
        assert "unfinished" in stderr
    assert call(capsys, "inspect", "t.zarr", "--verify")[0] == 3
    assert run(["inspect", "t.zarr"]) == 0
    assert "unfinished" in capsys.readouterr().out

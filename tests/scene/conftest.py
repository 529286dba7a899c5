"""A small scene folder that the tests of this room write variations of."""

from __future__ import annotations

from pathlib import Path

import pytest

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    """A folder with triangle.obj, textured.obj, sky.exr and wood.png (the last two only stand there)."""
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "triangle.obj").write_text(TRIANGLE)
    (folder / "textured.obj").write_text("vt 0 0\nvt 1 0\nvt 0 1\n" + TRIANGLE.replace("f 1 2 3", "f 1/1 2/2 3/3"))
    (folder / "sky.exr").write_bytes(b"")
    (folder / "wood.png").write_bytes(b"")
    return folder

import os
import re
import subprocess

import numpy as np
import pytest
import trimesh

from relightcli.adapters.images import read_image, write_image
from relightcli.cli.exits import (
    BAD_INPUT,
    BAD_STORE,
    BEYOND_TOLERANCE,
    INTERRUPTED,
    NUMERICAL,
    OK,
    SYSTEM,
)


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


@pytest.mark.slow
def test_the_first_scene_works_as_printed(root, relightcli, tmp_path):
    readme = (root / "README.md").read_text()
    (scene,), (commands,) = blocks(readme, "toml"), blocks(readme, "sh")
    assert len((scene + commands).splitlines()) == 10
    (tmp_path / "scene.toml").write_text(scene)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.apply_translation([0, 0.5, 0])
    ball.export(tmp_path / "bunny.ply")
    corners = [[-2, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]]
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "floor.ply")
    sky = np.full((16, 32, 3), 0.5, np.float32)
    sky[4, 20] = 200.0
    write_image(tmp_path / "sky.hdr", sky)
    environment = {**os.environ, "PATH": f"{relightcli.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["sh", "-e"], input=commands, text=True, cwd=tmp_path, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr
    picture, turned = read_image(tmp_path / "bunny.png"), read_image(tmp_path / "turned.exr")
    assert picture.pixels.shape[:2] == turned.pixels.shape[:2] == (480, 640)
    clay = turned.pixels[240, 320]
    # Clay under a white sky has the colour of its albedo, 0.7 to 0.4 to 0.3.
    assert np.allclose(clay[:3] / clay[0], [1, 4 / 7, 3 / 7], atol=1e-3)
    assert (clay[0], clay[3]) > (0.1, 0.99)


def test_the_exit_codes_are_those_of_the_program(root):
    rows = re.findall(r"^\| (\d+) \| ", (root / "README.md").read_text(), re.M)
    codes = [OK, BEYOND_TOLERANCE, BAD_INPUT, BAD_STORE, NUMERICAL, SYSTEM, INTERRUPTED]
    assert [int(row) for row in rows] == codes


def test_links_and_pictures_exist_and_are_small(root):
    for page in [root / "README.md", *(root / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).is_file(), f"{page.name}: {target}"
    pictures = list((root / "docs" / "pictures").iterdir())
    assert {p.name for p in pictures} == {"noon.png", "morning.png", "overcast.png"}
    assert all(p.stat().st_size < 150_000 for p in pictures)

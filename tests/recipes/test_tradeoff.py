import json

import numpy as np
import pytest

from relightcli.scene.model import Camera
from tests.core.transport.scenes import lambert, sphere, square
from tests.stages.scene_files import write_scene

pytestmark = pytest.mark.slow


def test_it_ends_in_a_check_and_leaves_the_page(make, tmp_path):
    parts = {"ground": square(2, material=lambert(0.5)), "ball": sphere(0.4, (0, 0.5, 0), rings=8)}
    camera = Camera("view", (0, 1.5, 3), (0, 0.3, 0), size=(16, 12))
    scene = write_scene(tmp_path / "own", parts, [camera], {"sky": np.ones((4, 8, 3))})
    variables = {"OUT": tmp_path / "out", "SCENE": scene, "CAMERA": "view", "BOUNCES": 0, "SPP": 32, "REPEATS": 1}
    # One point and a coarse truth: what is checked is that the recipe works.
    variables |= {"KNOBS": "light-resolution=16", "LIMIT": 0.2, "MORE": "--workers 1"}
    done = make("tradeoff", **variables)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed\n" in done.stdout
    assert f"The page is {tmp_path}/out/report/index.html" in done.stdout
    assert "light-resolution=16" in (tmp_path / "out" / "report" / "index.html").read_text()
    assert json.loads((tmp_path / "out" / "report.json").read_text())["points"][0]["label"] == "base"
    strict = make("tradeoff", **(variables | {"LIMIT": 0}))
    assert strict.returncode != 0
    assert "failed: the least error is" in strict.stderr

import re
import tomllib

import pytest

from relightcli.cli.main import COMMANDS, group
from relightcli.scene.parse import load_scene
from relightcli.stages.shots import Shot, read_shots
from tests.recipes.test_readme import blocks


def documented(text):
    """Options named by `usage.md` per command; those under Common options belong to all."""
    sections = dict(re.findall(r"^## (\S+[^\n]*)\n(.*?)(?=^## |\Z)", text, re.S | re.M))
    # The first cell of a table row, and for inspect the running text.
    cells = {name: "\n".join(re.findall(r"^\| (`-.*?) \|", body, re.M)) for name, body in sections.items()}
    cells["inspect"] = sections["inspect"]
    return {name: set(re.findall(r"`(--[a-z-]+)", body)) for name, body in cells.items()}


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_option_is_documented_and_no_other(root, name):
    command = group.get_command(None, name)
    assert command is not None
    real = {o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("--")}
    sections = documented((root / "docs" / "usage.md").read_text())
    common = sections["Common options"]
    assert real - common == sections[name] - common
    assert sections[name] <= real


def test_the_scene_and_the_keyframes_are_valid(root, tmp_path):
    scene, keys = blocks((root / "docs" / "usage.md").read_text(), "toml")
    for name in ("bunny.ply", "sky.exr"):
        (tmp_path / name).touch()
    (tmp_path / "scene.toml").write_text(scene)
    loaded = load_scene(tmp_path / "scene.toml")
    assert loaded.materials["gold"].adjustable
    # What is commented out is valid too, where the model uses it.
    lines = scene.splitlines()
    for model, key in (("phong", "shininess"), ("translucent", "transmittance")):
        written = next(line for line in lines if line.startswith(f"# {key}"))
        kept = [line for line in lines if not line.startswith(("f0", "roughness", "specular", "model"))]
        place = kept.index("[materials.gold]") + 1
        text = "\n".join([*kept[:place], f'model = "{model}"', written.removeprefix("# "), *kept[place:]])
        assert tomllib.loads(text)
        (tmp_path / "other.toml").write_text(text)
        assert load_scene(tmp_path / "other.toml").materials["gold"].model == model
    (tmp_path / "shots.toml").write_text(keys)
    shots = read_shots(tmp_path / "shots.toml", Shot(1, None, 0.0, None, 0.0, ()))
    assert len(shots) == 24
    assert [s.env_rotate for s in shots[:2]] == [0.0, 15.0]

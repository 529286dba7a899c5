"""Imports run one way: cli -> stages -> {plan, run, scene} -> adapters -> core. Read from the source; nothing runs."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import relightcli

PACKAGE = Path(relightcli.__file__).parent

# What each room may import of the project. `core` and `plan` know the plain records of `scene.model` and nothing else
# of `scene`; `errors` is the only module that all may import, and the only one below `stages` that knows the store
# format.
ALLOWED = {
    "cli": {"cli", "stages", "errors", "__version__"},
    "stages": {"stages", "plan", "run", "scene", "adapters", "core", "errors", "relight_formats", "__version__"},
    "plan": {"plan", "core", "scene.model", "errors"},
    "run": {"run", "errors", "__version__"},
    "scene": {"scene", "adapters", "core", "errors"},
    "adapters": {"adapters", "core", "errors"},
    "core": {"core", "scene.model", "errors"},
    "errors": {"relight_formats"},
    "__main__": {"cli"},
    "__init__": set(),
}

# `core` computes: no files, processes, logging, progress, or libraries that read and trace.
NOT_IN_CORE = {
    "pathlib",
    "os",
    "io",
    "logging",
    "tqdm",
    "click",
    "zarr",
    "trimesh",
    "embreex",
    "OpenImageIO",
    "tomllib",
}
NOT_IN_CORE |= {"subprocess", "multiprocessing", "random", "warnings", "sys", "json", "tempfile", "shutil"}


def imports(path, top_level_only=False):
    """Every module that a file imports, with `from package import module` written out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.lineno


def room_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def target(module, room):
    """Room (or scene.model, seen from core and plan) that a module of the project belongs to; None for others."""
    parts = module.split(".")
    if parts[0] == "relight_formats":
        return "relight_formats"
    if parts[0] != "relightcli":
        return None
    if room in ("core", "plan") and parts[1:3] == ["scene", "model"]:
        return "scene.model"
    return parts[1] if len(parts) > 1 else "__init__"


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_room_has_its_rule():
    assert {room_of(path) for path in FILES} == set(ALLOWED)


def test_imports_run_one_way():
    found = [
        f"{path.relative_to(PACKAGE.parent)}:{line}: {room_of(path)} imports {module}"
        for path in FILES
        for module, line in imports(path)
        if (to := target(module, room_of(path))) is not None and to not in ALLOWED[room_of(path)]
    ]
    assert not found, "\n".join(found)


def test_rules_have_no_cycle():
    # Apart from core's look at the records of scene.model, which itself imports nothing of the project.
    left = {room: needs - {room, "scene.model", "relight_formats", "__version__"} for room, needs in ALLOWED.items()}
    while left:
        free = [room for room, needs in left.items() if not needs & set(left)]
        assert free, f"cycle among {sorted(left)}"
        for room in free:
            del left[room]
    assert [m for m, _ in imports(PACKAGE / "scene" / "model.py") if m.startswith("reli")] == []


def test_core_only_computes():
    found = [
        f"{path.relative_to(PACKAGE.parent)}:{line}: {module}"
        for path in FILES
        if room_of(path) == "core"
        for module, line in imports(path)
        if module.split(".")[0] in NOT_IN_CORE
    ]
    assert not found, "\n".join(found)


def test_core_keeps_no_global_random_state():
    for path in FILES:
        if room_of(path) == "core":
            assert "np.random.seed" not in path.read_text(encoding="utf-8"), path


@pytest.mark.parametrize("name", sorted(p.name for p in (PACKAGE / "cli").glob("*.py")))
def test_commands_load_stages_only_when_they_run(name):
    # So that --help never pays for NumPy.
    heavy = {"numpy", "numba", "scipy", "zarr", "trimesh", "OpenImageIO"}
    for module, line in imports(PACKAGE / "cli" / name, top_level_only=True):
        first = module.split(".")[0]
        assert first not in heavy, f"{name}:{line}: {module}"
        assert not module.startswith("relightcli.stages"), f"{name}:{line}: {module}"


def test_the_store_format_knows_nothing_of_the_program():
    import relight_formats

    for path in Path(relight_formats.__file__).parent.rglob("*.py"):
        for module, line in imports(path):
            assert not module.startswith("relightcli"), f"{path}:{line}"

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def relightcli() -> Path:
    """The console script as a user has it."""
    script = Path(sysconfig.get_path("scripts")) / "relightcli"
    assert script.is_file(), f"{script} is missing; install the project with pip install --editable ."
    return script


@pytest.fixture(scope="session")
def make(relightcli):
    """Runs Make in a recipe's folder: make("demo", OUT=folder, ...); answers the finished process."""
    assert shutil.which("make"), "the recipes need Make"
    # Not those of a Make that runs the tests.
    clean = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES")}

    def run(recipe: str, *targets: str, **variables: object) -> subprocess.CompletedProcess[str]:
        known = {"RELIGHTCLI": relightcli, "PYTHON": sys.executable, **variables}
        command = ["make", "-C", ROOT / "recipes" / recipe, *targets, *(f"{k}={v}" for k, v in known.items())]
        return subprocess.run(command, env=clean, capture_output=True, text=True, timeout=600)

    return run

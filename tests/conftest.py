"""Fixtures that every room's tests share."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--figures", metavar="FILE", help="write outcomes and measured figures of all tests as JSON")


def pytest_configure(config: pytest.Config) -> None:
    target = config.getoption("--figures")
    if target and not hasattr(config, "workerinput"):  # with xdist the controller hears of all tests
        config.pluginmanager.register(Figures(Path(target)))


class Figures:
    """Collects what tests measured: node, outcome, and (what, measured, bound) of every `within`."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.rows: list[dict[str, object]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.outcome != "passed":
            figures = [value for key, value in report.user_properties if key == "figure"]
            self.rows.append({"node": report.nodeid, "outcome": report.outcome, "figures": figures})
            # Each time anew: what a run that is killed has measured is not lost.
            self.target.parent.mkdir(parents=True, exist_ok=True)
            self.target.write_text(json.dumps(self.rows, indent=1) + "\n")


@pytest.fixture
def within(request: pytest.FixtureRequest) -> Callable[[str, float, float], None]:
    """Asserts that a measured figure keeps its bound, and notes both for `--figures`."""

    def check(what: str, measured: float, bound: float) -> None:
        request.node.user_properties.append(("figure", [what, float(measured), float(bound)]))
        assert measured <= bound, f"{what}: measured {measured:.6g}, at most {bound:g}"

    return check


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the test data that is not part of the project: ../shared/data beside the checkout.

    RELIGHT_SHARED_DATA names another place; if it is set, the folder must exist.
    """
    override = os.environ.get("RELIGHT_SHARED_DATA")
    if override:
        assert Path(override).is_dir(), f"RELIGHT_SHARED_DATA={override} is no folder"
        return Path(override)
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"test data not found at {folder}; set RELIGHT_SHARED_DATA to the folder that holds INDEX.md")
    return folder

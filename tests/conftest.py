"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


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

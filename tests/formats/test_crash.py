"""Killed at any instruction: what is left is whole, and a rerun ends in the same bytes as a run that was left alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.formats.jobs import array_files, run

REPOSITORY = Path(__file__).resolve().parents[2]


def drive(scenario: str, folder: Path) -> Any:
    done = subprocess.run(
        [sys.executable, "-m", "tests.formats.crash_driver", scenario, str(folder)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("overwrite", [False, True], ids=["fresh", "overwrite"])
def test_death_before_every_change_of_the_file_system(tmp_path: Path, overwrite: bool) -> None:
    steps = drive("step-overwrite" if overwrite else "step-fresh", tmp_path)
    reference = tmp_path / "reference.zarr"
    run(reference, 2.0)

    *crashes, last = steps
    assert last["code"] == 0
    # The job makes at least one change for each of its 3 + 1 chunks, 5 documents, 3 ledger lines and 3 roots.
    assert len(crashes) >= 15
    assert {crash["code"] for crash in crashes} == {137}
    assert {step["at_end"] for step in steps} == {"factor 2"}
    assert all(step["files"] == array_files(reference) for step in steps)
    assert all(step["beside"] == [] for step in steps)

    left = [crash["after_crash"] for crash in crashes]
    if overwrite:
        assert set(left) == {"factor 1", "factor 2", "absent"}
        assert left.count("absent") == 1  # between the two renames of the swap, and nowhere else
    else:
        assert set(left) == {"absent", "factor 2"}


def test_twenty_sigkills_at_random_moments(tmp_path: Path) -> None:
    result = drive("random", tmp_path)
    assert result["kills"] == 20
    assert result["kills_with_finished_blocks"] >= 5  # the kills did hit runs in their middle
    assert result["different"] == []
    assert result["problems"] == [[]] * result["stores"]
    assert result["files"] == 2 * 40 + 3  # chunks, two arrays' metadata, one group

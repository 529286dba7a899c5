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


@pytest.mark.parametrize("scenario", ["fresh", "overwrite", "discard"])
def test_death_at_every_change_of_the_file_system(tmp_path: Path, scenario: str) -> None:
    *crashes, last = steps = drive(scenario, tmp_path)
    factor = 1.0 if scenario == "discard" else 2.0
    run(tmp_path / "reference.zarr", factor)

    assert last["code"] == 0
    # The job makes at least two changes for each of its 3 + 1 chunks, 5 documents and 3 roots, and 3 ledger lines.
    assert len(crashes) >= 27
    assert {crash["code"] for crash in crashes} == {137}
    assert {step["at_end"] for step in steps} == {f"factor {factor:g}"}
    assert all(step["files"] == array_files(tmp_path / "reference.zarr") for step in steps)
    assert all(step["beside"] == ["store.zarr"] for step in steps)

    left = [crash["after_crash"] for crash in crashes]
    if scenario == "overwrite":
        assert set(left) == {"factor 1", "factor 2", "absent"}
        assert left.count("absent") == 1  # between the two renames of the swap, and nowhere else
    else:
        assert set(left) == {"absent", "factor 2"}
    if scenario == "fresh":
        # After the commit mark there is nothing left to do but to give the name, and nothing is computed again.
        marked = [crash["after_crash"] for crash in crashes if not crash["worked"]]
        assert marked.count("absent") == 3  # at the removal of the ledger and of the notes, and at the rename
        assert marked.count("factor 2") >= 1


def test_twenty_sigkills_at_random_moments(tmp_path: Path) -> None:
    result = drive("random", tmp_path)
    assert result["kills"] == 20
    assert result["kills_with_finished_blocks"] >= 5  # the kills did hit runs in their middle
    assert result["different"] == []
    assert result["problems"] == [[]] * result["stores"]
    assert result["files"] == 2 * 40 + 3  # chunks, two arrays' metadata, one group

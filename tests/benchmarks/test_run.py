"""The benchmarks run, at their smallest, and leave well-formed results."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_quick_run(tmp_path):
    output = tmp_path / "bench.json"
    command = [sys.executable, "-m", "benchmarks", "visibility", "store", "--quick", "--output", str(output)]
    env = os.environ | {"RELIGHT_SHARED_DATA": str(tmp_path / "absent")}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    document = json.loads(output.read_text())
    assert document["format"] == 1
    assert document["machine"]["cores"] >= 1
    assert list(document["runs"]) == ["visibility", "store"]
    rows = [row for run in document["runs"].values() for row in run["report"]["rows"]]
    assert {"precompute, start of the program to its end", "write", "read", "stored"} <= {row["work"] for row in rows}
    for row in rows:
        # A benchmark that measures nothing shows as 0; bits that were found wrong may be 0.
        assert row["measured"] > 0 or row["work"].startswith("bits wrong")
        assert (row["met"] is None) == (row["target"] == "")
    ratio = next(row["ratio"] for row in rows if row["work"].startswith("visibility rays"))
    # Eight rays at once are at most eight times as fast as one by one; nor, on a busy machine, ten times slower.
    assert 0.1 < ratio < 8
    assert done.stdout.count("== ") == 2
    assert list(tmp_path.iterdir()) == [output]  # what was worked with is gone

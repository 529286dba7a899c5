"""A sample of the long run (`make faults`): every kind of fault, on the commands that take the least time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.faults.campaign import GROUPS, main, table
from tests.stages.test_tradeoff import ENVIRONMENT

ROOT = Path(__file__).parents[2]
# A store of several effects, a sequence of pictures, a radiance store, and path tracing with its samples.
STATIONS = "transfer,frames,radiance,reference"


def test_a_sample(tmp_path):
    command = [sys.executable, "-m", "tests.faults.campaign", "--stations", STATIONS, "--results", tmp_path / "r.jsonl"]
    asked = ["--kills", "16", "--corruptions", "16", "--others", "12", "--seed", "3"]
    done = subprocess.run([*command, *asked], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text().splitlines()]
    assert [row["problem"] for row in rows] == [""] * 44
    assert {row["group"] for row in rows} == set(GROUPS)


def test_violations_are_counted_and_told(tmp_path, capsys):
    """Without trials of its own, a run judges those that its file of results holds."""
    row = {"group": "kills", "number": 0, "station": "radiance", "fault": "killed_twice", "outcome": "", "problem": ""}
    wrong = {**row, "number": 1, "problem": "radiance.zarr differs"}
    assert "1 (1 WRONG)" in table([wrong])
    assert "WRONG" not in table([row])
    results = tmp_path / "r.jsonl"
    results.write_text("".join(json.dumps(r) + "\n" for r in (row, wrong)))
    assert main(["--kills", "2", "--results", str(results)]) == 1
    assert "2 trials, 1 violations" in capsys.readouterr().out
    results.write_text(json.dumps(row) + "\n" + '{"group": "kills", "num')  # cut off while it was written
    assert main(["--kills", "1", "--results", str(results)]) == 0

"""The benchmark of direct light by transfer tensors, at its smallest."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_quick_run(tmp_path):
    output = tmp_path / "bench.json"
    command = [sys.executable, "-m", "benchmarks", "direct", "--quick", "--output", str(output)]
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text())["runs"]["direct"]["report"]
    (table,) = report["tables"]
    # Three numbers of coefficients for the default, one for the variant; two skies, two f0.
    assert len(table["rows"]) == (3 + 1) * 4
    for row in table["rows"]:
        assert all(0.0 < error < 2.0 for error in row[3:])
    assert all(row["measured"] > 0.0 for row in report["rows"])

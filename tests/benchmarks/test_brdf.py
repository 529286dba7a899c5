"""The benchmark of the BRDF tensor, at its smallest."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from benchmarks import brdf

ROOT = Path(__file__).parents[2]


def test_quick_run(tmp_path):
    output = tmp_path / "bench.json"
    command = [sys.executable, "-m", "benchmarks", "brdf", "--quick", "--output", str(output)]
    # Matrices this small gain nothing from a second thread, and wait for it on a busy machine.
    env = os.environ | {"RELIGHT_SHARED_DATA": str(tmp_path / "absent"), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(output.read_text())["runs"]["brdf"]["report"]
    if find_spec("matplotlib"):
        assert (tmp_path / "brdf.png").read_bytes()[:4] == b"\x89PNG"
        assert not report["skipped"]
    else:
        assert "matplotlib" in report["skipped"][0]
    by_work = {row["work"]: row for row in report["rows"]}
    for name in ("Cook-Torrance", "Blinn-Phong"):
        direct = by_work[f"{name}: the same as n_h = 4, n = 8, with lobes, by HOOI on the whole tensor"]
        # On the core HOOI can only do worse, but for another local optimum; here by less than one part in a thousand.
        assert 0.999 < direct["ratio"] < 1.001
    (grid,) = (table["rows"] for table in report["tables"] if table["title"] == "relative squared error")
    assert len(grid) == 4 * len(brdf.QUICK_N_I)
    for row in grid:
        errors = np.array(row[3:], float)
        assert (errors > 0).all()
        assert (errors < 1).all()
        # More entries' factors, smaller error; HOOI from another start may differ by its local optimum.
        assert (np.diff(errors) <= 1e-4 * errors[:-1]).all()
    for start in range(0, len(grid), len(brdf.QUICK_N_I)):
        finer = np.array([row[3:] for row in grid[start : start + len(brdf.QUICK_N_I)]], float)
        assert (np.diff(finer, axis=0) < 0).all()


def test_errors_by_entry_add_up_to_the_whole():
    rng = np.random.default_rng(0)
    values = rng.uniform(size=(9, 40, 40)) * 0.9 ** np.arange(40)
    found = brdf.curves(values, values, [brdf.DEFAULT])
    norms = (values**2).sum((1, 2))
    whole = (found.by_entry[brdf.DEFAULT] * norms).sum() / norms.sum()
    assert whole == pytest.approx(found.error[brdf.DEFAULT], abs=1e-12)  # differences of squares, relative to |f|^2

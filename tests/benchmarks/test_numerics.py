"""Every numerical kernel keeps its digits: `make numerics` prints the table, each of its rows is a test here.

The bounds and where they come from stand with the cases, in benchmarks/numerics.
"""

from __future__ import annotations

from pathlib import Path

import mpmath
import numpy as np
import pytest

import relightcli
from benchmarks.numerics.case import case, harmonics, relative, run
from benchmarks.numerics.table import EXCUSED, cases, markdown

CORE = Path(relightcli.__file__).parent / "core"


@pytest.mark.parametrize("one", cases(), ids=lambda c: c.kernel.replace(" ", "_"))
def test_digits(one):
    loss = run(one)
    assert loss.met, f"{loss.kernel}: {loss.lost:.2f} digits lost (error {loss.largest:.2e}), at most {loss.bound}"
    assert loss.kernel in markdown([loss])


def test_every_file_of_core_has_a_row_or_a_reason():
    files = {str(path.relative_to(CORE)) for path in CORE.rglob("*.py") if path.name != "__init__.py"}
    shown = {module for one in cases() for module in one.modules if module.endswith(".py")}
    assert shown <= files
    assert set(EXCUSED) == files - shown
    names = [one.kernel for one in cases()]
    assert len(set(names)) == len(names)


def test_a_loss_is_seen():
    """1 - cos(1e-6) in float64 keeps four digits of sixteen; NaN counts as an infinite loss."""
    before = len(cases())
    try:
        case("probe", "display.py", "", "float64", 1.0, "")(
            lambda: relative(np.array([1.0 - np.cos(1e-6)]), [2 * mpmath.sin(mpmath.mpf(5e-7)) ** 2])
        )
        loss = run(cases()[-1])
        assert not loss.met
        assert 11 < loss.lost < 13.5
        case("probe", "display.py", "", "float64", 1.0, "")(lambda: relative(np.array([np.nan]), [mpmath.mpf(1)]))
        assert run(cases()[-1]).lost == np.inf
    finally:
        del cases()[before:]


def test_harmonics_of_the_reference():
    """Its own check: the sum rule, sum over m of y_lm^2 = (2 l + 1) / (4 pi), and y_11 along x without a sign."""
    y = harmonics([0.3, -0.5, 0.8], 5)
    for band in range(5):
        total = sum(v * v for v in y[band * band : (band + 1) ** 2])
        assert abs(total - (2 * band + 1) / (4 * mpmath.pi)) < 1e-45
    assert float(harmonics([1.0, 0, 0], 2)[3]) == pytest.approx(np.sqrt(3 / (4 * np.pi)), rel=1e-15)

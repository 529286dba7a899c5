"""Measured materials: the 86 Cook-Torrance fits of [Ngan 2005] as parameters of our own Cook-Torrance model.

    theirs   f = kd/pi + ks F D G / (pi (n.l)(n.v))             [Ngan 2005, supplemental]
    ours     f = diffuse/pi + specular F D G / (4 (n.l)(n.v))   (see `models`)

with the same F (Schlick), D (Beckmann, with its 1/pi) and G (V-cavity) in both, so that

    diffuse = c kd,   specular = 4/pi c ks,   f0 and roughness = m as published.

c = (1.00, 1.15, 1.66) is the scale of red, green and blue in which the MERL database is stored and that its own reader
(BRDFRead.cpp) puts back; the table is in the stored units. The paper does not print the factor in front of the lobe
beside the table: 1/pi is the reading under which the fits agree with the paper's own Ward fits to the same
measurements, see tests/core/brdf/test_measured.py.

One fit, colonial-maple-223 (f0 = 0.0017), has a specular colour above 1, up to 1.25. It is kept: the product with F
is what was measured, and the material still reflects less than it gets.

[Ngan 2005] A. Ngan, F. Durand, W. Matusik: Experimental Analysis of BRDF Models. Eurographics Symposium on Rendering.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources

from relightcli.core.brdf.models import Triple

MERL_SCALE: Triple = (1.00, 1.15, 1.66)


@dataclass(frozen=True)
class MeasuredFit:
    """Cook-Torrance parameters of one measured material, in the units of a scene file.

    diffuse, specular: linear RGB, at least 0; f0: 0 to 1; roughness: Beckmann m, above 0.
    """

    name: str
    diffuse: Triple
    specular: Triple
    f0: float
    roughness: float


@cache
def fits() -> tuple[MeasuredFit, ...]:
    """All fits in the order of the published table, which comes with the package."""
    text = resources.files(__package__).joinpath("ngan2005.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return tuple(
        MeasuredFit(
            row["name"],
            _colour(row, "kd", 1.0),
            _colour(row, "ks", 4.0 / math.pi),
            float(row["f0"]),
            float(row["m"]),
        )
        for row in rows
    )


def _colour(row: dict[str, str], column: str, factor: float) -> Triple:
    r, g, b = (factor * c * float(row[f"{column}_{band}"]) for c, band in zip(MERL_SCALE, "rgb", strict=True))
    return r, g, b

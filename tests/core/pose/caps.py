"""Visibility over the upper hemisphere with a round blocker, by quadrature."""

import math

import numpy as np

from relightcli.core.sphere import sh


def caps(azimuth: np.ndarray, elevation: np.ndarray, half: float, order: int = 4) -> np.ndarray:
    """Coefficients (F, order^2) float32: blockers of half-angle `half`, everything in degrees. half < 0: none."""
    x, w = np.polynomial.legendre.leggauss(120)
    phi = 2.0 * math.pi * (np.arange(240) + 0.5) / 240
    z, f = np.meshgrid(0.5 * (1.0 + x), phi, indexing="ij")
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(f), r * np.sin(f), z], -1).reshape(-1, 3)
    basis = sh.harmonics(directions, order) * (np.repeat(0.5 * w, 240) * 2.0 * math.pi / 240)[:, None]
    a, e = np.radians(azimuth), np.radians(elevation)
    centre = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    visible = centre @ directions.T < math.cos(math.radians(half)) if half >= 0 else np.ones((len(a), len(z.flat)))
    return (visible @ basis).astype(np.float32)


def swing(centre: float, frames: int = 41, half: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Features (F, 1), radians, and visibility (F, 1, 16) of a blocker at 35 degrees that swings 30 degrees about an
    azimuth."""
    turn = np.linspace(-30.0, 30.0, frames)
    return np.radians(turn)[:, None], caps(centre + turn, np.full(frames, 35.0), half)[:, None]

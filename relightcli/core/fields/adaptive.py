"""Where a field is sampled, by the error of interpolating between the samples. [left open in Pan 2007, section 6]

Looked at is what the object hides, h(q) = even light less its occlusion, which its transfer follows. Linear
interpolation over a step of length s errs by s^2 |h''| / 8. So shells are placed where the integral over log r of
|h''| ^ 1/2 grows by equal steps, h'' measured on PILOT_SHELLS shells in PILOT^2 directions of every cube face, relative
to h on its shell. A share EVEN of the mean is added everywhere, so that no gap opens where little is measured.

Directions: the coarsest cube map whose four texels around a texel's corner, averaged, are within a tolerance of what is
seen from the corner's direction itself, relative RMS over the innermost shell.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.body import Body
from relightcli.core.fields.field import GEOMETRIC_RANGE
from relightcli.core.fields.sampling import blocked, cone_rays, trace
from relightcli.core.sphere import cube, sh
from relightcli.core.transport.tracer import Tracer

PILOT_SHELLS, PILOT = 25, 2
RAYS = 2048
EVEN = 0.1
RESOLUTIONS = (8, 16, 32)
_BATCH = 32


def adaptive_radii(tracer: Tracer, body: Body, count: int, seed: int = 0) -> NDArray[np.float64]:
    """Radii (count,) float64, rising, over the range of geometric ones; count >= 2. Rays over the body's mesh alone."""
    fine = np.log(np.geomspace(*GEOMETRIC_RANGE, PILOT_SHELLS))
    directions = cube.texel_directions(PILOT).reshape(-1, 3)
    hidden = np.stack([_hidden(tracer, body, body.radius * math.exp(x) * directions, seed) for x in fine])
    size = np.sqrt((hidden**2).sum(axis=2).mean(axis=1))
    bend = np.sqrt((np.diff(hidden, 2, axis=0) ** 2).sum(axis=2).mean(axis=1)) / np.maximum(size[1:-1], 1e-300)
    density = np.sqrt(np.concatenate([bend[:1], bend, bend[-1:]]))
    if not density.any():
        return body.radius * np.geomspace(*GEOMETRIC_RANGE, count)
    density += EVEN * density.mean()
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    out: NDArray[np.float64] = body.radius * np.exp(np.interp(np.linspace(0.0, total[-1], count), total, fine))
    return out


def shell_error(tracer: Tracer, body: Body, radii: NDArray[np.float64], seed: int = 0) -> float:
    """Relative error of interpolating what is hidden, linear in log r, half way between neighbouring shells; RMS over
    the pilot's directions, the largest of all gaps."""
    directions = cube.texel_directions(PILOT).reshape(-1, 3)
    seen = [_hidden(tracer, body, r * directions, seed) for r in radii]
    worst = 0.0
    for k, r in enumerate(np.sqrt(radii[1:] * radii[:-1])):
        truth = _hidden(tracer, body, r * directions, seed)
        worst = max(worst, _relative(0.5 * (seen[k] + seen[k + 1]), truth))
    return worst


def direction_error(tracer: Tracer, body: Body, radius: float, resolution: int, seed: int = 0) -> float:
    """Relative RMS error of interpolating between the directions of a shell, at the corners of texels."""
    centres = cube.texel_centers(resolution)
    corners = np.arange(1, resolution, dtype=np.float64) * (2.0 / resolution) - 1.0
    ours, truth = [], []
    for face in range(6):
        at = cube.face_directions(face, centres[None, :], centres[:, None]).reshape(-1, 3)
        seen = _hidden(tracer, body, radius * at, seed).reshape(resolution, resolution, -1)
        ours.append(0.25 * (seen[1:, 1:] + seen[1:, :-1] + seen[:-1, 1:] + seen[:-1, :-1]).reshape(-1, seen.shape[2]))
        at = cube.face_directions(face, corners[None, :], corners[:, None]).reshape(-1, 3)
        truth.append(_hidden(tracer, body, radius * at, seed))
    return _relative(np.concatenate(ours), np.concatenate(truth))


def least_resolution(
    tracer: Tracer, body: Body, radius: float, tolerance: float, seed: int = 0, choices: tuple[int, ...] = RESOLUTIONS
) -> int:
    """The first of `choices` whose directions are within the tolerance on a shell of this radius, or the last."""
    for resolution in choices[:-1]:
        if direction_error(tracer, body, radius, resolution, seed) <= tolerance:
            return resolution
    return choices[-1]


def _hidden(tracer: Tracer, body: Body, offsets: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Coefficients (n, N) of what the body hides from center + offsets (n, 3), all outside its bounding sphere."""
    out = np.empty((len(offsets), body.order**2))
    for a in range(0, len(offsets), _BATCH):
        points = body.center + offsets[a : a + _BATCH]
        directions, weight = cone_rays(points, body.center, body.radius, RAYS, a, seed)
        found = trace(tracer, body, tracer.to_local(points), directions, weight)
        harmonics = sh.harmonics(found.direction.astype(np.float64), body.order).astype(np.float32)
        out[a : a + _BATCH] = blocked(found, harmonics)
    return out


def _relative(ours: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    size = float((truth**2).sum())
    return math.sqrt(float(((ours - truth) ** 2).sum()) / size) if size > 0.0 else 0.0

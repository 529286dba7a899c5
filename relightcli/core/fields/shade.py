"""The shading step: exit radiance of points from the light that reaches them. [Pan 2007, section 5]

    B = albedo / pi  sum_i A_i y_i(n) (T L)_i          diffuse, exact for light of the order
    B += sum_i F_i(view) (T L)_i                       specular: slices of the lobe (see `shade.low_order`)

L the light that comes to the point from outside its object, in the object's frame; T its self transfer, summed over the
proxies: the object's own shadow and reflections on itself. (The paper's text leaves the latter out, though they are
stored.) Points of what has no self transfer, T = 1, are lit by all that stands above their horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.fields.body import axes, clamped_cosine
from relightcli.core.parts import in_parts
from relightcli.core.shade.low_order import shade_low_order
from relightcli.core.sphere import sh
from relightcli.core.sphere.rotation import rotation_matrices

_BLOCK = 2048
LANES = 64
_MANY = 16_384  # points: fewer are shaded sooner than shared out


class Receivers(NamedTuple):
    """What points of one object, in its frame, make of light: to_diffuse (P, N, C) float32, so that B is its product
    with L; to_frame (P, N, N, C) float32: T, then into the point's own frame (see `body.axes`), none if nothing shines;
    normal (P, 3) float32; by_order: `to_diffuse` in parts, with no own reflection, with one, with more; none unless it
    is needed."""

    to_diffuse: NDArray[np.float32]
    to_frame: NDArray[np.float32]
    normal: NDArray[np.float32]
    by_order: tuple[NDArray[np.float32], ...] = ()

    def at(self, points: slice | NDArray[np.int64]) -> Receivers:
        """Some of the points, for diffuse light alone."""
        return self._replace(to_diffuse=self.to_diffuse[points], by_order=tuple(part[points] for part in self.by_order))


def make_receivers(
    normals: NDArray[np.float32],
    albedo: NDArray[np.floating],
    order: int,
    transfer: NDArray[np.float32] | None = None,
    shines: bool = False,
) -> Receivers:
    """normals (P, 3) unit, albedo (P, 3), the self transfer (P, m, N, N, C) or None; all of it once per object."""
    count, n = len(normals), order * order
    colours = 3 if transfer is None or transfer.shape[4] == 3 else 1
    h = sh.harmonics(normals.astype(np.float64), order) * clamped_cosine(order) / np.pi
    to_diffuse = np.empty((count, n, 3), np.float32)
    to_frame = np.empty((count if shines else 0, n, n, 1 if transfer is None else colours), np.float32)
    frames = axes(normals)
    for a in range(0, count, _BLOCK):
        part = slice(a, min(a + _BLOCK, count))
        if transfer is None:
            whole = np.broadcast_to(np.eye(n)[None, :, :, None], (part.stop - a, n, n, 1))
        else:
            whole = transfer[part].sum(1, dtype=np.float64)
        to_diffuse[part] = np.einsum("pi,pijc->pjc", h[part], whole) * albedo[part, None, :]
        if shines:
            to_frame[part] = np.einsum("pki,pijc->pkjc", rotation_matrices(frames[part], order), whole)
    return Receivers(to_diffuse, to_frame, normals)


def diffuse(
    receivers: Receivers, light: NDArray[np.float32], turn: NDArray[np.float64], threads: int = 1
) -> NDArray[np.float32]:
    """Diffuse exit radiance (P, 3) float32 under light (P, 3, N) in the world's frame; turn (N, N) takes
    coefficients of the object's frame there. It may be negative, by what the order cuts off: see `never_negative`."""
    out = np.empty((len(light), 3), np.float32)
    back = np.ascontiguousarray(turn, np.float32)
    by = receivers.to_diffuse
    threads = threads if len(light) >= _MANY else 1
    in_parts(lambda a, b: _diffuse(by[a:b], light[a:b], back, out[a:b]), len(light), threads)
    return out


def diffuse_by_order(
    receivers: Receivers, lights: Sequence[NDArray[np.float32]], turn: NDArray[np.float64], threads: int = 1
) -> NDArray[np.float32]:
    """The same of light that was reflected in all, on the object or elsewhere, as often as lights[0]: lights[k], (P, 3,
    N), was reflected k times less before it came there. What was reflected more often on the object is left out."""
    out = np.zeros((len(lights[0]), 3), np.float32)
    for by, light in zip(receivers.by_order, lights, strict=False):
        out += diffuse(receivers._replace(to_diffuse=by), light, turn, threads)
    return out


def specular(
    receivers: Receivers,
    light: NDArray[np.float32],
    turn: NDArray[np.float64],
    view: NDArray[np.float32],
    table: NDArray[np.float32],
    colour: NDArray[np.float32],
    threads: int = 1,
) -> NDArray[np.float32]:
    """Specular exit radiance (P, 3) float32 towards view (P, 3), unit, in the object's frame; light and turn as before,
    table (POLAR, B) of the lobe from `low_order.response`, colour (3,)."""
    n = light.shape[2]
    local = (light.reshape(-1, n) @ turn.astype(np.float32)).reshape(light.shape)
    own = np.empty_like(local)
    colours = receivers.to_frame.shape[3]
    for c in range(3):
        own[:, c] = np.matmul(receivers.to_frame[..., c % colours], local[:, c, :, None])[..., 0]
    count = len(light)
    return shade_low_order(
        np.arange(count),
        own,
        np.zeros((count, 3), np.float32),
        receivers.normal,
        np.ascontiguousarray(view, np.float32),
        table[None],
        np.asarray(colour, np.float32).reshape(1, 3),
        np.zeros(count, np.int32),
        threads,
    )[0]


def never_negative(radiance: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Radiance with what rings below 0 put to 0, and the least value that it had."""
    least = float(radiance.min(initial=0.0))
    return np.maximum(radiance, np.float32(0.0)), least


@njit(cache=True, nogil=True, fastmath={"contract"})
def _diffuse(by, light, turn, out):  # type: ignore[no-untyped-def]
    """LANES points at a time, one beside the other in memory."""
    n = light.shape[2]
    there, own = np.zeros((n, LANES), np.float32), np.empty((n, LANES), np.float32)
    for first in range(0, len(light), LANES):
        lanes = min(LANES, len(light) - first)
        for c in range(3):
            for lane in range(lanes):
                for i in range(n):
                    there[i, lane] = light[first + lane, c, i]
            own[:] = np.float32(0.0)
            start, width = 0, 1
            while start < n:  # band by band: a rotation mixes no others
                for i in range(start, start + width):
                    for j in range(start, start + width):
                        t = turn[i, j]
                        for lane in range(LANES):
                            own[j, lane] += t * there[i, lane]
                start, width = start + width, width + 2
            for lane in range(lanes):
                total = np.float32(0.0)
                for j in range(n):
                    total += by[first + lane, j, c] * own[j, lane]
                out[first + lane, c] = total

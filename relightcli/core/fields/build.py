"""The field around an object: occlusion and radiance transfer at samples on shells. [Pan 2007, Eqs. 5 to 7]

With the exit radiance e of the object's points per light at its proxies (`self_transfer`), a sample's transfer is one
sum over the rays that hit, M_q = sum of w y(direction) e(-direction): no matrix is made per ray.

The occlusion is sqrt(4 pi) delta_0 - sum of w y over the same rays. For a white object under even light M_q is the same
sum: what it hides of the light it gives back, to round-off.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.body import Body, axes
from relightcli.core.fields.field import Field, SelfTransfer, shell_radii
from relightcli.core.fields.lobe_functions import FunctionExits, gather_by_function
from relightcli.core.fields.proxies import place_proxies, proxy_weights
from relightcli.core.fields.sampling import blocked, cone_rays, gather, sample_points, trace
from relightcli.core.fields.self_transfer import solve
from relightcli.core.fields.shared_exits import SharedExits, gather_shared, share_exits
from relightcli.core.sphere import sh
from relightcli.core.transport.tracer import Tracer

RAYS = 1024  # of a sample, through the cone of the bounding sphere; four times as many from inside it
_BATCH = 64  # samples traced together
Exits: TypeAlias = NDArray[np.float32] | SharedExits | FunctionExits


class Samples(NamedTuple):
    """A range of samples: valid (n,) bool, occlusion (n, N) float32, transfer (n, m, N, N, C) float32; rays."""

    valid: NDArray[np.bool_]
    occlusion: NDArray[np.float32]
    transfer: NDArray[np.float32]
    rays: int


def field_samples(
    tracer: Tracer,
    body: Body,
    exits: Exits,
    radii: NDArray[np.float64],
    resolution: int,
    start: int,
    stop: int,
    rays: int = RAYS,
    seed: int = 0,
) -> Samples:
    """Samples start .. stop, counted through all shells. exits (P, terms, m N C) from `self_transfer.solve`, as it is,
    from `short`, or by the functions of `lobe_functions`, which take the place of colours.

    A sample is not valid if more than half of what is seen from it are backs of one-sided faces: it lies inside.
    """
    n = body.order**2
    lights = exits.shape[2] if isinstance(exits, np.ndarray) else exits.lights
    colours = 1 + len(exits.table) if isinstance(exits, FunctionExits) else body.colours
    proxies = lights // (n * colours)
    frames = axes(body.normal)
    valid = np.ones(stop - start, bool)
    occlusion = np.empty((stop - start, n), np.float32)
    transfer = np.empty((stop - start, proxies, n, n, colours), np.float32)
    points = sample_points(body.center, radii, resolution, start, stop)
    inside = ((points - body.center) ** 2).sum(axis=1) <= body.radius**2
    traced = 0
    for batch in _batches(inside):
        rows = slice(*batch)
        count = 4 * rays if inside[rows.start] else rays
        directions, weight = cone_rays(points[rows], body.center, body.radius, count, start + rows.start, seed)
        found = trace(tracer, body, tracer.to_local(points[rows]), directions, weight)
        harmonics = sh.harmonics(found.direction.astype(np.float64), body.order).astype(np.float32)
        hidden = blocked(found, harmonics)
        hidden[:, 0] -= math.sqrt(4.0 * math.pi)
        occlusion[rows] = -hidden
        if isinstance(exits, SharedExits):
            seen = gather_shared(found, harmonics, exits, body, frames)
        elif isinstance(exits, FunctionExits):
            seen = gather_by_function(found, harmonics, exits, body, frames)
        else:
            seen = gather(found, harmonics, exits, body, frames)
        transfer[rows] = seen.reshape(-1, n, proxies, n, colours).transpose(0, 2, 1, 3, 4)
        valid[rows] = 2 * found.back <= count
        traced += len(weight) * count
    return Samples(valid, occlusion, transfer, traced)


def short(body: Body, exits: NDArray[np.float32], proxies: NDArray[np.float64]) -> NDArray[np.float32] | SharedExits:
    """Exits in the form that is summed fastest: of a diffuse object, a number per light, as they are."""
    return exits if body.terms == 1 else share_exits(exits, proxy_weights(body.point, proxies, body.radius))


def _batches(inside: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Ranges of up to _BATCH samples, each all inside or all outside."""
    cuts = [0, *(np.flatnonzero(np.diff(inside.astype(np.int8))) + 1), len(inside)]
    out = []
    for a, b in itertools.pairwise(cuts):
        out += [(k, min(k + _BATCH, b)) for k in range(int(a), int(b), _BATCH)]
    return out


def build_field(
    tracer: Tracer,
    body: Body,
    shells: int = 16,
    resolution: int = 16,
    proxies: int = 8,
    spacing: str = "geometric",
    rays: int = RAYS,
    tolerance: float = 0.01,
    seed: int = 0,
) -> tuple[Field, SelfTransfer]:
    """Field and self transfer of a body, in this process; tracer over its mesh alone."""
    centres = place_proxies(body.point, proxies, seed)
    solution = solve(tracer, body, centres, tolerance, seed)
    radii = shell_radii(body.radius, shells, spacing)
    cells = 6 * resolution * resolution
    exits = short(body, solution.exits, centres)
    found = field_samples(tracer, body, exits, radii, resolution, 0, shells * cells, rays, seed)
    field = Field(
        body.center,
        body.radius,
        radii,
        resolution,
        found.valid.reshape(shells, cells),
        centres,
        found.occlusion.reshape(shells, cells, -1),
        found.transfer.reshape(shells, cells, *found.transfer.shape[1:]),
    )
    return field, SelfTransfer(solution.transfer)

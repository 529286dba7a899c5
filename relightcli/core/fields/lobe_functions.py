"""Fields of objects whose specular material is changed afterwards: one for each of a few functions.

What an object of one material sends is a sum over its diffuse colour and its lobe, of which the harmonics' responses
F_lm(theta) (`shade.low_order`) are all that a field of few bands knows:

    M = diffuse M_0 + specular sum over k of c_k M_k,        F ~ sum over k of c_k F_k

M_0 of a white diffuse object, M_k of one with lobe F_k and nothing else, c_k of the material: hanging on its roughness
or exponent and f0. The F_k are lobes of the model themselves, those that span its whole range best, in the measure of
solid angle times the view's cosine; a lobe that is weak beside the mirror's at its width counts from RARE of it on. The
c_k are scaled so that the light that is sent under an even sky is right.

What an object reflects on itself is that of the material that it was simulated with, in grey. A coloured texture
colours what is sent by its mean. [left open in Pan 2007, whose materials are fixed]
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.separable import POLAR
from relightcli.core.compress.span import span
from relightcli.core.fields.body import Body
from relightcli.core.fields.proxies import proxy_weights
from relightcli.core.fields.sampling import Found, gather
from relightcli.core.fields.self_transfer import exits_of
from relightcli.core.fields.shared_exits import SharedExits, gather_shared, share_exits
from relightcli.core.shade.low_order import responses

FUNCTIONS = 4  # of the lobe; the diffuse one comes on top
RARE = 0.3


@lru_cache(maxsize=8)
def lobe_functions(model: int, order: int) -> NDArray[np.float32]:
    """F_k (FUNCTIONS, POLAR, B) of a model code with a specular lobe."""
    lobes = responses(model, order).table
    weighed = _weighed(lobes)
    norm = np.sqrt((weighed**2).sum(axis=2))
    rows = weighed / np.maximum(norm, RARE * norm[:, 1:])[..., None]
    rows = rows.reshape(-1, rows.shape[2])
    chosen, _ = span(np.einsum("ad,bd->ab", rows, rows), most=FUNCTIONS)
    return lobes.reshape(len(rows), POLAR, -1)[chosen].astype(np.float32)


def _weighed(lobes: NDArray[np.floating]) -> NDArray[np.float64]:
    """Lobes (..., POLAR, B) as vectors (..., POLAR B) of the measure."""
    x = (np.arange(POLAR) + 0.5) / POLAR  # sqrt(1 - cos): cos d omega is 4 pi x (1 - x^2) dx
    out = np.asarray(lobes, np.float64) * np.sqrt(x * (1.0 - x * x))[:, None]
    return out.reshape(*lobes.shape[:-2], -1)


def sent_evenly(lobes: NDArray[np.floating]) -> NDArray[np.float64]:
    """The share of even light that surfaces reflect by lobes (..., POLAR, B): the integral of 2 cos sin sqrt(4 pi)
    F_00(theta) d theta."""
    x = (np.arange(POLAR) + 0.5) / POLAR
    shares = 4.0 * x * (1.0 - x * x) / POLAR * math.sqrt(4.0 * math.pi)
    return np.asarray((np.asarray(lobes[..., 0], np.float64) * shares).sum(axis=-1))


def mix(functions: NDArray[np.float32], lobe: NDArray[np.float32]) -> NDArray[np.float64]:
    """c_k (FUNCTIONS,) of a lobe (POLAR, B), of whichever model."""
    own, wanted = _weighed(functions), _weighed(lobe)
    found = np.linalg.solve(own @ own.T, own @ wanted).astype(np.float64)
    sent = float(found @ sent_evenly(functions))
    return np.asarray(found * (float(sent_evenly(lobe)) / sent) if sent > 0.0 else found, np.float64)


def function_weights(
    functions: NDArray[np.float32],
    lobe: NDArray[np.float32],
    diffuse: NDArray[np.floating],
    specular: NDArray[np.floating],
) -> NDArray[np.float64]:
    """What the fields of the functions count for a lobe and colours (3,): (1 + FUNCTIONS, 3), (.., 1) if all colours
    have the same."""
    of_lobe = mix(functions, lobe)[:, None] * np.reshape(specular, (1, 3))
    out = np.concatenate([np.reshape(diffuse, (1, 3)), of_lobe]).astype(np.float64)
    return out if (np.ptp(out, axis=1) > 0.0).any() else out[:, :1]


class FunctionExits(NamedTuple):
    """diffuse (P, 1, m N) float32 of white points; lobes of points that send specular coefficients alone; table
    (FUNCTIONS, POLAR, B): what these make of them."""

    diffuse: NDArray[np.float32]
    lobes: SharedExits
    table: NDArray[np.float32]

    @property
    def lights(self) -> int:
        """m N C, C functions."""
        return self.lobes.lights * (1 + len(self.table))


def exits_by_function(
    body: Body, model: int, transfer: NDArray[np.float32], texture: NDArray[np.floating], proxies: NDArray[np.float64]
) -> FunctionExits:
    """Exits of a body of that model code with a lobe, its self transfer (P, m, N, N, C); texture (P,) in grey."""
    white = body._replace(albedo=np.repeat(np.asarray(texture, np.float64)[:, None], 3, 1), specular=np.ones(3))
    exits = exits_of(white, transfer.mean(axis=4, keepdims=True))
    diffuse = exits[:, :1].copy()
    exits[:, 0] = 0.0
    lobes = share_exits(exits, proxy_weights(body.point, proxies, body.radius))
    return FunctionExits(diffuse, lobes, lobe_functions(model, body.order))


def gather_by_function(
    found: Found, harmonics: NDArray[np.float32], exits: FunctionExits, body: Body, frames: NDArray[np.float64]
) -> NDArray[np.float32]:
    """`sampling.gather` of the functions, one beside the other: (S, N, m N C) float32."""
    parts = [gather(found, harmonics, exits.diffuse, body, frames)]
    parts += [gather_shared(found, harmonics, exits.lobes, body._replace(lobe=one), frames) for one in exits.table]
    return np.stack(parts, axis=-1).reshape(*parts[0].shape[:2], -1)

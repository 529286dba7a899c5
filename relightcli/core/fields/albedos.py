"""Fields of an object whose albedo is changed afterwards: what was simulated at three albedos, at any other.

An object that reflects on itself passes light on in every order: with K what arrives of one more reflection,

    T(a) = (1 - a K)^-1 T(0),    M(a) = a G T(a),

T its self transfer, M what it sends. Both are known at the albedos a_n of NODES, which take the place of colours when
the object is simulated, and are interpolated for each colour's own albedo a:

    T(a) ~ sum over n of l_n(a) T(a_n),    M(a) ~ sum over n of l_n(a) a / a_n M(a_n),    l_n(a_k) = delta_nk quadratic

What is left out is of third order in K: nothing for a convex object, where K = 0. A texture of greys is part of K and
G. [left open in Pan 2007, whose materials are fixed]

Of an object with a specular lobe one transfer is known, at the material that it was simulated with. What its own points
make of light follows every change (`fields.shade`); what it sends to others is taken in proportion to all the light
that it reflects, M ~ M(old) rho / rho(old). For a convex object under even light that is right in its amount; the
directions stay those of the old lobe, and reflections on itself those of the old material.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.separable import POLAR
from relightcli.core.fields.compression import CompressedTransfer
from relightcli.core.fields.entities import Transfer

# The third-order error of (1 - a K)^-1, K = 1/2 as in half a sphere, is about 1 % at 0, 0.8 and 1.
NODES = (0.15, 0.6, 0.95)


def self_weights(albedo: tuple[float, float, float]) -> NDArray[np.float64]:
    """l_n of every colour's albedo, (3 nodes, 3 colours), or (3, 1) if all colours have the same."""
    a = np.array(albedo if len(set(albedo)) > 1 else albedo[:1])
    out = np.ones((len(NODES), len(a)))
    for n, node in enumerate(NODES):
        for other in NODES[:n] + NODES[n + 1 :]:
            out[n] *= (a - other) / (node - other)
    return out


def transfer_weights(albedo: tuple[float, float, float]) -> NDArray[np.float64]:
    """The same times a / a_n."""
    a = np.array(albedo if len(set(albedo)) > 1 else albedo[:1])
    return self_weights(albedo) * a / np.array(NODES)[:, None]


def reflectance(
    diffuse: NDArray[np.floating], specular: NDArray[np.floating], lobe: NDArray[np.float32]
) -> NDArray[np.float64]:
    """rho (3,): the share of even light that a surface reflects, of diffuse and specular colours (3,) and the lobe's
    responses (POLAR, B) (`fields.body`): diffuse + specular * integral of 2 cos sin sqrt(4 pi) F_00(theta) d theta."""
    x = (np.arange(POLAR) + 0.5) / POLAR  # sqrt(1 - cos), of which F is a table: 2 cos sin d theta is 4 x (1 - x^2) dx
    of_lobe = float((4.0 * x * (1.0 - x * x) * lobe[:, 0]).sum()) / POLAR * math.sqrt(4.0 * math.pi)
    found: NDArray[np.float64] = np.asarray(diffuse, np.float64) + np.asarray(specular, np.float64) * of_lobe
    return found


@dataclass(frozen=True)
class Scaled:
    """A transfer times a factor (3,) of every colour."""

    transfer: Transfer
    factor: NDArray[np.float32]

    def reflect(self, light: NDArray[np.floating], which: NDArray[np.integer]) -> NDArray[np.float32]:
        out: NDArray[np.float32] = self.transfer.reflect(light, which) * self.factor[:, None]
        return out


def transfer_at(made: CompressedTransfer, albedo: tuple[float, float, float]) -> CompressedTransfer:
    """A transfer whose colours are the nodes, for an object of this albedo (3,), 0 to 1."""
    m, n, _, nodes = made.shape
    weights = transfer_weights(albedo).astype(np.float32)
    mixed = made.component.reshape(-1, nodes).astype(np.float32) @ weights
    colours = weights.shape[1]
    return replace(made, shape=(m, n, n, colours), component=mixed.reshape(len(made.component), -1))

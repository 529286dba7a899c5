"""Fields of an object whose albedo is changed afterwards: what was simulated at three albedos, at any other.

An object that reflects on itself passes light on in every order: with K what arrives of one more reflection,

    T(a) = (1 - a K)^-1 T(0),    M(a) = a G T(a),

T its self transfer, M what it sends. Both are known at the albedos a_n of NODES, which take the place of colours when
the object is simulated, and are interpolated for each colour's own albedo a:

    T(a) ~ sum over n of l_n(a) T(a_n),    M(a) ~ sum over n of l_n(a) a / a_n M(a_n),    l_n(a_k) = delta_nk quadratic

What is left out is of third order in K: nothing for a convex object, where K = 0. A texture of greys is part of K and
G. [left open in Pan 2007, whose materials are fixed]

Objects with a specular lobe: `lobe_functions`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.compression import CompressedTransfer

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


def mixed(made: CompressedTransfer, weights: NDArray[np.float64]) -> CompressedTransfer:
    """A transfer of nodes or functions in the place of colours, for an object that weighs them so: (nodes, colours)."""
    m, n, _, nodes = made.shape
    weight = weights.astype(np.float32)
    component = made.component.reshape(-1, nodes).astype(np.float32) @ weight
    return replace(made, shape=(m, n, n, weight.shape[1]), component=component.reshape(len(made.component), -1))


def transfer_at(made: CompressedTransfer, albedo: tuple[float, float, float]) -> CompressedTransfer:
    """A transfer whose colours are the nodes, for an object of this albedo (3,), 0 to 1."""
    return mixed(made, transfer_weights(albedo))

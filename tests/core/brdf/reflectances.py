"""Materials, directions and quadrature for tests of reflectance."""

from types import SimpleNamespace

import numpy as np

from relightcli.core.brdf.models import evaluate_many, pack_materials

N = np.array([0.0, 0.0, 1.0])
ALBEDO = np.array([0.6, 0.3, 0.1])
SPECULAR = np.array([0.9, 0.7, 0.2])
TRANSMITTANCE = np.array([0.2, 0.5, 0.4])


def material(model, **values):
    defaults = {"f0": 0.04, "roughness": 0.3, "shininess": 50.0}
    colours = {"diffuse": tuple(ALBEDO), "specular": tuple(SPECULAR), "transmittance": tuple(TRANSMITTANCE)}
    return SimpleNamespace(model=model, **{**defaults, **colours, **values})


def white(model, **values):
    """Specular lobe alone, of colour 1."""
    return material(model, diffuse=(0, 0, 0), specular=(1, 1, 1), **values)


def value(m, light, view):
    return evaluate_many(pack_materials([m]), np.array(0), np.array(m.diffuse), N, np.asarray(light), np.asarray(view))


def direction(theta, phi=0.0):
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def random_directions(count, seed, lowest=-1.0):
    rng = np.random.default_rng(seed)
    z, phi = rng.uniform(lowest, 1, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], -1)


def hemisphere(rings=400, columns=400):
    """Gauss-Legendre in cos theta, midpoints in phi: directions and weights that sum to 2 pi."""
    x, w = np.polynomial.legendre.leggauss(rings)
    theta = np.arccos(0.5 * (x + 1))
    phi = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    weight = np.repeat(0.5 * w * 2 * np.pi / columns, columns)
    return direction(np.repeat(theta, columns), np.tile(phi, rings)), weight

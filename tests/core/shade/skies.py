"""Skies, receivers and materials for tests of shading."""

from types import SimpleNamespace

import numpy as np

from relightcli.core.sphere import cube
from relightcli.core.transport.visibility import horizon_bits
from tests.core.brdf.reflectances import random_directions


def smooth_map(height=32, width=64):
    """Radiance between 0.1 and 1.9, bright above and in the front."""
    lat = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
    lon = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)
    value = 1 + 0.5 * np.sin(lat) + 0.4 * np.cos(lat) * np.cos(lon)
    return np.repeat(value[..., None], 3, axis=2).astype(np.float32)


def patchy_map(seed, height=32, width=64):
    """Patches of 4 x 4 pixels of very different radiance, colours apart."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.random((height // 4, width // 4, 3)) ** 4, np.ones((4, 4, 1))).astype(np.float32)


def sunny_map():
    """A smooth sky and a sun of 5.6 degrees of ten times its power."""
    pixels = smooth_map()
    pixels[7, 20] = [5000.0, 4000.0, 2500.0]
    return pixels


def views(normals, seed, most=1.45):
    """Unit directions at angles from 0.02 to `most` radians from the normals, anywhere around them."""
    t = np.cross(normals, np.random.default_rng(seed).normal(size=normals.shape))
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    angle = np.linspace(0.02, most, len(normals))[:, None]
    return (np.cos(angle) * normals + np.sin(angle) * t).astype(np.float32)


def caps(normals, resolution, seed):
    """Horizon bits less three round occluders of 53 degrees each: about half the sky."""
    bits = horizon_bits(normals, resolution)
    d = cube.texel_directions(resolution)
    seen = [(d @ random_directions(3, seed + i).T < 0.6).all(-1) for i in range(len(normals))]
    return bits & np.packbits(np.array(seen), axis=-1, bitorder="little")


def shiny(model, **values):
    """A specular lobe of colour 1."""
    black = (0.0, 0.0, 0.0)
    defaults = {"f0": 0.5, "roughness": 0.3, "shininess": 50.0}
    return SimpleNamespace(
        model=model, diffuse=black, specular=(1.0, 1.0, 1.0), transmittance=black, **{**defaults, **values}
    )

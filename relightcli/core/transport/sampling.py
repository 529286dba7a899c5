"""Sample points that depend on nothing but (seed, pixel, pass, sample, dimension).

Each pair of dimensions is a (0,2)-sequence (the first two of Sobol'), Owen-scrambled and shuffled by hashes of the
key, so that pairs are independent of each other and passes are independent repetitions: within a pass the points of a
pixel are stratified, and the spread of the passes measures the error. [Kollig-Keller 2002; Burley 2020, sections 2-4;
hash constants: Vegdahl 2021]
"""

from __future__ import annotations

import numpy as np
from numba import njit

_LOW = np.uint64(0xFFFFFFFF)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@njit(cache=True)
def _mix(z: np.uint64) -> np.uint64:
    """A bijective 64-bit hash. [Steele 2014, SplitMix64]"""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def stream_key(seed: int, pixel: int, replicate: int) -> np.uint64:
    """Key (uint64) of the sample points of one pixel in one pass."""
    return _mix(_mix(_mix(np.uint64(seed) + _GOLDEN) + np.uint64(pixel) * _GOLDEN) + np.uint64(replicate) * _GOLDEN)


@njit(cache=True)
def _reverse(x: np.uint64) -> np.uint64:
    """The 32 bits of x in reverse order."""
    x = ((x >> np.uint64(1)) & np.uint64(0x55555555)) | ((x & np.uint64(0x55555555)) << np.uint64(1))
    x = ((x >> np.uint64(2)) & np.uint64(0x33333333)) | ((x & np.uint64(0x33333333)) << np.uint64(2))
    x = ((x >> np.uint64(4)) & np.uint64(0x0F0F0F0F)) | ((x & np.uint64(0x0F0F0F0F)) << np.uint64(4))
    x = ((x >> np.uint64(8)) & np.uint64(0x00FF00FF)) | ((x & np.uint64(0x00FF00FF)) << np.uint64(8))
    return (x >> np.uint64(16)) | ((x & np.uint64(0xFFFF)) << np.uint64(16))


@njit(cache=True)
def _scramble_reversed(x: np.uint64, key: np.uint64) -> np.uint64:
    """Owen scrambling of a number whose bits are reversed: every bit is flipped by a hash of the lower ones."""
    x = (x ^ (x * np.uint64(0x3D20ADEA))) & _LOW
    x = (x + key) & _LOW
    x = (x * ((key >> np.uint64(16)) | np.uint64(1))) & _LOW
    x = (x ^ (x * np.uint64(0x05526C56))) & _LOW
    return (x ^ (x * np.uint64(0x53A22864))) & _LOW


@njit(cache=True)
def point(key: np.uint64, sample: int, dimension: int) -> tuple[float, float]:
    """The pair of numbers in (0, 1) of sample `sample` (0 .. 2^32 - 1) in the pair of dimensions `dimension`."""
    base = _mix(key + np.uint64(dimension) * _GOLDEN)
    more = _mix(base ^ _GOLDEN)
    index = _reverse(_scramble_reversed(_reverse(np.uint64(sample)), more & _LOW))
    # The second Sobol' dimension is Pascal's triangle mod 2: sums over the supersets of a bit position.
    second = index
    second ^= (second >> np.uint64(1)) & np.uint64(0x55555555)
    second ^= (second >> np.uint64(2)) & np.uint64(0x33333333)
    second ^= (second >> np.uint64(4)) & np.uint64(0x0F0F0F0F)
    second ^= (second >> np.uint64(8)) & np.uint64(0x00FF00FF)
    second ^= (second >> np.uint64(16)) & np.uint64(0x0000FFFF)
    x = _reverse(_scramble_reversed(index, base & _LOW))
    y = _reverse(_scramble_reversed(second, base >> np.uint64(32)))
    return (np.float64(x) + 0.5) * 2.0**-32, (np.float64(y) + 0.5) * 2.0**-32

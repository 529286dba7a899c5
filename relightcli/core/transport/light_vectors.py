"""Light transfer vectors on demand: which receivers a light from any direction reaches.

Simulated visibility of R x R texels a face says for most receivers what a ray would: where the four texel centres
around a direction agree, so does the direction. Only where they do not is a ray traced, so that a vector of tens of
thousands of receivers costs some hundreds of rays. Bits are kept texel first, receivers packed: 64 to a word.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.bits import trailing_zeros
from relightcli.core.sphere import cube
from relightcli.core.transport.tracer import Tracer

ON_CENTRE = 1e-6  # of a texel: directions as near to a centre as this are taken to be on it


def transpose_bits(blocks: Iterable[tuple[slice, NDArray[np.uint8]]], out: NDArray[np.uint64]) -> None:
    """Fills out (T, ceil(N / 64)) uint64 with visibility by texel from blocks of receivers (n, 6, R, R/8) uint8."""
    for rows, bits in blocks:
        assert rows.start % 64 == 0
        _transpose(np.ascontiguousarray(bits.reshape(len(bits), -1)), rows.start // 64, out)


@njit(cache=True, nogil=True)
def _transpose(bits, first, out):  # type: ignore[no-untyped-def]
    """512 receivers at a time, so that both sides are met line by line; 8 x 8 bits at once [Warren 2012, sec. 7-3]."""
    n = bits.shape[0]
    turned = np.zeros(8, np.uint64)
    for part in range(0, n, 512):
        for byte in range(bits.shape[1]):
            for at in range(part, min(part + 512, n), 64):
                turned[:] = np.uint64(0)
                for group in range(at, min(at + 64, n), 8):
                    x = np.uint64(0)
                    for i in range(min(8, n - group)):
                        x |= np.uint64(bits[group + i, byte]) << np.uint64(8 * i)
                    y = (x ^ (x >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
                    x = x ^ y ^ (y << np.uint64(7))
                    y = (x ^ (x >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
                    x = x ^ y ^ (y << np.uint64(14))
                    y = (x ^ (x >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
                    x = x ^ y ^ (y << np.uint64(28))
                    for k in range(8):
                        turned[k] |= ((x >> np.uint64(8 * k)) & np.uint64(255)) << np.uint64(group - at)
                for k in range(8):
                    out[8 * byte + k, first + (at >> 6)] = turned[k]


class LightVectors:
    """Visibility of lights in any direction, as bits of receivers.

    base (T, W) uint64: bits by texel of 6 x R x R, W = ceil(N / 64); position (N, 3) world, normal (N, 3) unit; tracer
    None: nothing blocks. `rays` counts what was traced.
    """

    def __init__(
        self,
        base: NDArray[np.uint64],
        position: NDArray[np.float64],
        normal: NDArray[np.float32],
        tracer: Tracer | None,
    ) -> None:
        self.base = base
        self.resolution = round((len(base) / 6) ** 0.5)
        self.normal = np.ascontiguousarray(normal, np.float32)
        self.tracer = tracer
        self.origin = None if tracer is None else tracer.offset(position, normal)
        self.rays = 0

    def visible(self, directions: NDArray[np.float64]) -> NDArray[np.uint64]:
        """(S, W) uint64: bit i of row s is 1 where the light from directions[s] (S, 3) reaches receiver i."""
        texels = surrounding_texels(directions, self.resolution)
        out = np.empty((len(directions), self.base.shape[1]), np.uint64)
        count = _agree(self.base, texels, out)
        if count:
            row, receiver = np.empty(count, np.int32), np.empty(count, np.int32)
            light = directions.astype(np.float32)
            count = _doubtful(self.base, texels, self.normal, light, row, receiver)
            row, receiver = row[:count], receiver[:count]
            lit = np.ones(count, bool)
            if self.tracer is not None and self.origin is not None:
                lit = ~self.tracer.occluded(self.origin[receiver], light[row])
                self.rays += count
            _set_bits(row, receiver, lit, out)
        return out


def surrounding_texels(directions: NDArray[np.float64], resolution: int) -> NDArray[np.int64]:
    """Flat indices (S, 4) of the texels whose centres surround each direction; four times its own where it is on the
    centre. Beyond a face's border the texel that the continued plane points at."""
    d = np.asarray(directions, np.float64)
    own = cube.texel_index(d, resolution)
    face = own // (resolution * resolution)
    along = np.einsum("ni,ni->n", d, cube.FACE_AXIS[face])
    a, b = (
        (np.einsum("ni,ni->n", d, axes[face]) / along + 1.0) * (0.5 * resolution) - 0.5
        for axes in (cube.FACE_RIGHT, cube.FACE_DOWN)
    )
    on = np.maximum(np.abs(a - np.round(a)), np.abs(b - np.round(b))) < ON_CENTRE
    out = np.empty((len(d), 4), np.int64)
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        s, t = (2.0 * (np.floor(x) + step + 0.5) / resolution - 1.0 for x, step in ((a, j), (b, i)))
        around = cube.FACE_AXIS[face] + s[:, None] * cube.FACE_RIGHT[face] + t[:, None] * cube.FACE_DOWN[face]
        out[:, k] = np.where(on, own, cube.texel_index(around, resolution))
    return out


@njit(cache=True, nogil=True)
def _agree(base, texels, out):  # type: ignore[no-untyped-def]
    """Bits that all four texels have; returns how many receivers see some of them only."""
    doubtful = 0
    for s in range(len(texels)):
        a, b, c, d = base[texels[s, 0]], base[texels[s, 1]], base[texels[s, 2]], base[texels[s, 3]]
        for w in range(out.shape[1]):
            every = a[w] & b[w] & c[w] & d[w]
            out[s, w] = every
            rest = (a[w] | b[w] | c[w] | d[w]) ^ every
            while rest != np.uint64(0):
                doubtful += 1
                rest &= rest - np.uint64(1)
    return doubtful


@njit(cache=True, nogil=True)
def _doubtful(base, texels, normal, light, row, receiver):  # type: ignore[no-untyped-def]
    """Writes those of them above whose horizon the light stands; returns their number."""
    n = 0
    for s in range(len(texels)):
        a, b, c, d = base[texels[s, 0]], base[texels[s, 1]], base[texels[s, 2]], base[texels[s, 3]]
        for w in range(base.shape[1]):
            rest = (a[w] | b[w] | c[w] | d[w]) ^ (a[w] & b[w] & c[w] & d[w])
            while rest != np.uint64(0):
                i = 64 * w + trailing_zeros(rest)  # type: ignore[call-arg]
                rest &= rest - np.uint64(1)
                height = normal[i, 0] * light[s, 0] + normal[i, 1] * light[s, 1] + normal[i, 2] * light[s, 2]
                if height > np.float32(0.0):
                    row[n], receiver[n] = s, i
                    n += 1
    return n


@njit(cache=True, nogil=True)
def _set_bits(row, receiver, lit, out):  # type: ignore[no-untyped-def]
    for k in range(len(row)):
        if lit[k]:
            out[row[k], receiver[k] >> 6] |= np.uint64(1) << np.uint64(receiver[k] & 63)

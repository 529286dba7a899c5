"""From the radiance of receivers to pixels: a sparse matrix of barycentric weights, made once per camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.parts import in_parts
from relightcli.core.shade.primary import Samples
from relightcli.core.transport.shading import Surface, surface_at, white_scene
from relightcli.scene.model import Geometry


@dataclass(frozen=True)
class PixelMatrix:
    """Rows are pixels, columns receivers, in compressed rows.

    start (P + 1,) int64; receiver (Z,) int32; weight (Z,) float32; texture (Z, 3) float32, the texture's colour that
    the receivers' diffuse light is multiplied by, or (0, 3) where no material has one.
    """

    start: NDArray[np.int64]
    receiver: NDArray[np.int32]
    weight: NDArray[np.float32]
    texture: NDArray[np.float32]

    def used(self, count: int) -> NDArray[np.bool_]:
        """Which of `count` receivers any pixel needs, (count,)."""
        out = np.zeros(count, bool)
        out[self.receiver] = True
        return out


def lit_surface(geometry: Geometry, samples: Samples) -> Surface:
    """The surface at those samples that can send light to the camera; `path` is the sample, `albedo` the texture."""
    n = len(samples.face)
    return surface_at(
        white_scene(geometry),
        samples.face,
        samples.u,
        samples.v,
        samples.direction.astype(np.float64),
        np.ones((n, 3)),
        np.arange(n, dtype=np.int64),
    )


def vertex_matrix(
    geometry: Geometry,
    samples: Samples,
    face_normals: NDArray[np.float32],
    front: NDArray[np.int32],
    back: NDArray[np.int32],
    buried: NDArray[np.bool_],
    pixels: int,
) -> PixelMatrix:
    """Weights of the three corners' receivers at every sample. front, back (V,): receiver of a vertex's side, or -1;
    buried (N,): receivers that the face's others stand in for."""
    seen = lit_surface(geometry, samples)
    sample = seen.path
    receiver = np.empty((len(sample), 3), np.int32)
    weight = np.empty((len(sample), 3), np.float32)
    _corners(
        sample,
        seen.geometric,
        samples.face,
        samples.u,
        samples.v,
        samples.weight,
        geometry.faces,
        face_normals,
        front,
        back,
        buried,
        receiver,
        weight,
    )
    texture = np.zeros((0, 3), np.float32)
    if geometry.textures:
        texture = np.repeat(seen.albedo.astype(np.float32), 3, axis=0)
    start = 3 * np.searchsorted(samples.pixel[sample], np.arange(pixels + 1))
    return PixelMatrix(
        start.astype(np.int64),
        receiver.reshape(-1),
        weight.reshape(-1),
        texture,
    )


@njit(cache=True)
def _corners(  # type: ignore[no-untyped-def]
    sample, geometric, face, u, v, share, faces, face_normals, front, back, buried, receiver, weight
):
    """Receivers at the corners of the faces that samples see, and their barycentric weights times the sample's."""
    for i in range(len(sample)):
        s = sample[i]
        f = face[s]
        # The side is the one that `lit_surface` chose: a second test against the ray could round to the other one.
        side = 0.0
        for x in range(3):
            side += face_normals[f, x] * geometric[i, x]
        barycentric = (1.0 - np.float64(u[s]) - np.float64(v[s]), np.float64(u[s]), np.float64(v[s]))
        kept = 0.0
        for k in range(3):
            corner = faces[f, k]
            receiver[i, k] = front[corner] if side > 0.0 else back[corner]
            if not buried[receiver[i, k]]:
                kept += barycentric[k]
        scale = share[s] / kept if kept > 0.0 else np.float64(share[s])
        for k in range(3):
            hidden = kept > 0.0 and buried[receiver[i, k]]
            weight[i, k] = 0.0 if hidden else barycentric[k] * scale


def sample_matrix(
    pixel: NDArray[np.int32], weight: NDArray[np.float32], texture: NDArray[np.float32], pixels: int
) -> PixelMatrix:
    """The matrix of receivers that are camera samples themselves, in any order."""
    order = np.argsort(pixel, kind="stable")
    start = np.searchsorted(pixel[order], np.arange(pixels + 1))
    return PixelMatrix(start.astype(np.int64), order.astype(np.int32), weight[order], texture[order])


def share_out(
    samples: Samples,
    seen: Surface,
    object: NDArray[np.int32],
    pixel: NDArray[np.int32],
    position: NDArray[np.float64],
    receiver_object: NDArray[np.int32],
    texture: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Weight (N,) and mean texture (N, 3) of camera samples' receivers by finer `samples` of the same pixels, and their
    coverage (H, W) without those whose pixel has no receiver.

    seen: `lit_surface` of `samples`; object (S,) of what they see. Each speaks for the nearest receiver of its pixel on
    the same object, or on any if there is none. pixel, receiver_object (N,), position, texture (N, 3) of the receivers,
    in any order; who gets no sample keeps its texture at weight 0.
    """
    order = np.argsort(pixel, kind="stable")
    start = np.searchsorted(pixel[order], np.arange(samples.coverage.size + 1))
    k = seen.path
    total, lost = np.zeros((len(pixel), 4)), np.zeros(samples.coverage.size)
    _share_out(
        samples.pixel[k], samples.weight[k], object[k], seen.position, seen.albedo,
        start, order, position, receiver_object, total, lost,
    )  # fmt: skip
    weight = total[:, 3]
    mean = np.divide(total[:, :3], weight[:, None], out=texture.astype(np.float64), where=weight[:, None] > 0)
    coverage = np.maximum(samples.coverage - lost.reshape(samples.coverage.shape), 0.0)
    return weight.astype(np.float32), mean.astype(np.float32), coverage.astype(np.float32)


@njit(cache=True)
def _share_out(  # type: ignore[no-untyped-def]
    pixel, weight, object, place, colour, start, order, position, receiver_object, total, lost
):
    for s in range(len(pixel)):
        best, least = -1, np.inf
        for z in range(start[pixel[s]], start[pixel[s] + 1]):
            r = order[z]
            d = 0.0
            for x in range(3):
                d += (position[r, x] - place[s, x]) ** 2
            if receiver_object[r] != object[s]:
                d += 1e30
            if d < least:
                best, least = r, d
        if best >= 0:
            for x in range(3):
                total[best, x] += weight[s] * colour[s, x]
            total[best, 3] += weight[s]
        else:
            lost[pixel[s]] += weight[s]


def assemble(
    matrix: PixelMatrix,
    diffuse: NDArray[np.float32],
    specular: NDArray[np.float32] | None = None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Pixels (P, 3) float32 from the receivers' diffuse and specular exit radiance (N, 3); textures act on diffuse."""
    pixels = len(matrix.start) - 1
    out = np.zeros((pixels, 3), np.float32)
    if specular is None:
        specular = np.zeros((0, 3), np.float32)

    def part(a: int, b: int) -> None:
        _multiply(matrix.start[a : b + 1], matrix.receiver, matrix.weight, matrix.texture, diffuse, specular, out[a:b])

    in_parts(part, pixels, threads)
    return out


@njit(cache=True, nogil=True)
def _multiply(start, receiver, weight, texture, diffuse, specular, out):  # type: ignore[no-untyped-def]
    textured = len(texture) > 0
    shiny = len(specular) > 0
    for p in range(len(out)):
        r = g = b = np.float32(0.0)
        for z in range(start[p], start[p + 1]):
            k = receiver[z]
            w = weight[z]
            if textured:
                r += w * texture[z, 0] * diffuse[k, 0]
                g += w * texture[z, 1] * diffuse[k, 1]
                b += w * texture[z, 2] * diffuse[k, 2]
            else:
                r += w * diffuse[k, 0]
                g += w * diffuse[k, 1]
                b += w * diffuse[k, 2]
            if shiny:
                r += w * specular[k, 0]
                g += w * specular[k, 1]
                b += w * specular[k, 2]
        out[p, 0] = r
        out[p, 1] = g
        out[p, 2] = b

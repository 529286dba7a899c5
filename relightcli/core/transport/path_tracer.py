"""The reference: a wavefront path tracer over the same materials, lights and bounces as the precomputed transport.

At every surface point, up to K bounces deep, the light is estimated by `estimators`: by sampling the lights and by
sampling the reflectance together. K bounces means K interreflections: layer k holds the light that was reflected k + 1
times, but for layer 0, which has diffuse reflection alone; what specular lobes make of it is in layer K + 1.

Samples come in independent passes of `samples_per_pass`, stratified within a pass; the spread of the passes gives the
variance. Every random number hangs on (seed, pixel, pass, sample) alone, so the picture does not depend on how it was
cut into rows, passes or processes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.core.brdf.models import TRANSLUCENT
from relightcli.core.lights.latlong import LatLong
from relightcli.core.transport import estimators
from relightcli.core.transport.camera import Film, approach, make_film
from relightcli.core.transport.local_lights import LIGHT_CLEARANCE
from relightcli.core.transport.shading import ShadingScene, surface_at
from relightcli.core.transport.tracer import Tracer
from relightcli.scene.model import Camera

# Paths in flight: 700 bytes each; larger batches are no faster.
BATCH = 1 << 16


@dataclass(frozen=True)
class Tile:
    """Sums over `passes` passes of what each pass measured, for some rows of the picture, float64.

    layers (L, H, W, 3): radiance reflected once, diffusely; 2 .. K + 1 times; once, by specular lobes; then, with
    background, the environment seen directly
    squares (H, W, 3): of the passes' beauty; alpha (H, W): of the passes' coverage; rays: how many were traced
    Tiles of further passes of the same rows add up (`+`).
    """

    layers: NDArray[np.float64]
    squares: NDArray[np.float64]
    alpha: NDArray[np.float64]
    passes: int
    rays: int

    def __add__(self, other: Tile) -> Tile:
        return Tile(
            self.layers + other.layers,
            self.squares + other.squares,
            self.alpha + other.alpha,
            self.passes + other.passes,
            self.rays + other.rays,
        )


@dataclass(frozen=True)
class Picture:
    """Radiance, associated with alpha, float32.

    layers (L, H, W, 3); beauty (H, W, 3), their float32 sum from first to last; alpha (H, W), 0..1;
    variance (H, W, 3) of the beauty, that is of the mean over all samples: its square root is the standard error.
    """

    layers: NDArray[np.float32]
    beauty: NDArray[np.float32]
    alpha: NDArray[np.float32]
    variance: NDArray[np.float32]


def split_samples(spp: int) -> tuple[int, int]:
    """(passes, samples_per_pass) for at least `spp` samples per pixel: a power of two per pass, 16 passes or more
    (fewer below 16 samples, but 2 at least, or the variance would be unknown)."""
    per_pass = 1 << max(0, (max(spp, 1) // 16).bit_length() - 1)
    return max(2, -(-spp // per_pass)), per_pass


def resolve(tile: Tile) -> Picture:
    """The picture that a tile's passes agree on. Needs two passes.

    variance = (sum x^2 - (sum x)^2 / n) / (n (n - 1)) over the n passes.
    """
    n = tile.passes
    if n < 2:
        raise ValueError(f"variance needs at least 2 passes, found {n}")
    layers = (tile.layers / n).astype(np.float32)
    beauty = layers[0].copy()
    for layer in layers[1:]:
        beauty += layer
    total = tile.layers.sum(axis=0)
    variance = np.maximum(tile.squares - total * total / n, 0.0) / (n * (n - 1.0))
    return Picture(layers, beauty, (tile.alpha / n).astype(np.float32), variance.astype(np.float32))


def trace_rows(
    scene: ShadingScene,
    tracer: Tracer,
    environment: LatLong,
    camera: Camera,
    rows: tuple[int, int],
    passes: tuple[int, int],
    samples_per_pass: int,
    bounces: int,
    seed: int = 0,
    background: bool = False,
    blocks: bool = True,
) -> Tile:
    """Trace rows `rows[0] <= y < rows[1]` of a picture, passes `passes[0] <= p < passes[1]`.

    scene: `shading_scene(...)`; tracer: over the same positions and faces; environment: `make_latlong(...)`, a black
    1 x 1 map for none; samples_per_pass >= 1, best a power of two; bounces K >= 0; background: fill what the camera
    sees past the scene with the environment; blocks: whether surfaces block light, needed for K > 0. Memory: 700 bytes
    per path, max(BATCH, samples_per_pass) paths.
    """
    film = make_film(camera)
    first, count = rows[0] * film.width, (rows[1] - rows[0]) * film.width
    layers = np.zeros((bounces + 2 + background, count, 3))
    squares = np.zeros((count, 3))
    alpha = np.zeros(count)
    chunk = max(1, BATCH // samples_per_pass)
    rays = 0
    for start in range(0, count, chunk):
        stop = min(start + chunk, count)
        for number in range(*passes):
            paths = _Paths(seed, first + start, stop - start, number, samples_per_pass)
            values, hit, traced = _trace_paths(scene, tracer, environment, film, paths, bounces, background, blocks)
            estimators.add_pass(
                values, hit, samples_per_pass, layers[:, start:stop], squares[start:stop], alpha[start:stop]
            )
            rays += traced
    shape = (rows[1] - rows[0], film.width)
    return Tile(
        layers.reshape(-1, *shape, 3),
        squares.reshape(*shape, 3),
        alpha.reshape(shape),
        passes[1] - passes[0],
        rays,
    )


@dataclass(frozen=True)
class _Paths:
    """A batch: all samples of one pass through `pixels` pixels from `first_pixel` on, pixel by pixel."""

    seed: int
    first_pixel: int
    pixels: int
    number: int
    samples: int


def _trace_paths(
    scene: ShadingScene,
    tracer: Tracer,
    environment: LatLong,
    film: Film,
    paths: _Paths,
    bounces: int,
    background: bool,
    blocks: bool,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Radiance per path and layer (N, L, 3), whether its camera ray hit anything (N,), and the number of rays."""
    n = paths.pixels * paths.samples
    keys = estimators.path_keys(paths.seed, paths.first_pixel, paths.pixels, paths.number)
    direction = np.empty((n, 3))
    estimators.camera_rays(film, keys, paths.first_pixel, paths.samples, direction)
    origins = tracer.to_local(approach(film.eye, direction, tracer.center, tracer.scale))
    hits = tracer.intersect(origins, direction.astype(np.float32))
    rays = n
    covered = hits.face >= 0
    values = np.zeros((n, bounces + 2 + background, 3))
    lobes, shares, none = bounces + 1, np.zeros((n, 3)), np.zeros((0, 3))
    if background:
        estimators.add_background(environment, hits.face, direction, values)
    surface = surface_at(scene, hits.face, hits.u, hits.v, direction, np.ones((n, 3)), np.arange(n))

    shadow: Tracer | _Nothing = tracer if blocks else _Nothing()
    lit_by_lights = scene.lights.number > 0
    two_origins = bool((scene.model == TRANSLUCENT).any())
    for k in range(bounces + 1):
        if len(surface.path) == 0:
            break
        front = tracer.offset(surface.position, surface.geometric)
        back = tracer.offset(surface.position, -surface.geometric) if two_origins else front
        known, wanted = (none, shares) if k == 0 else (shares, none)
        if environment.density > 0.0:
            source, below, direction, gain, share = estimators.sample_environment(
                scene, environment, surface, keys, paths.samples, 3 * k + 1, known
            )
            blocked = shadow.occluded(_origins(front, back, source, below), direction.astype(np.float32))
            estimators.add_light(values, k, lobes, surface.path, source, gain, blocked, share)
            rays += len(source)
        if lit_by_lights:
            source, below, target, gain, share = estimators.sample_lights(
                scene, surface, keys, paths.samples, 3 * k + 2, known
            )
            origins = _origins(front, back, source, below)
            reach = np.full(len(source), 1.0 - LIGHT_CLEARANCE, np.float32)
            blocked = shadow.occluded(origins, tracer.to_local(target) - origins, reach)
            estimators.add_light(values, k, lobes, surface.path, source, gain, blocked, share)
            rays += len(source)

        last = k == bounces
        if last and not (environment.lit or lit_by_lights):
            break
        source, below, direction, throughput, density = estimators.sample_reflection(
            scene, surface, keys, paths.samples, 3 * k + 3, wanted
        )
        origins = _origins(front, back, source, below)
        toward = direction.astype(np.float32)
        rays += len(source)
        if last and not lit_by_lights:
            face = np.where(shadow.occluded(origins, toward), 0, -1).astype(np.int32)
            estimators.add_found_environment(
                values, k, lobes, shares, surface.path, source, environment, face, direction, throughput, density
            )
            break
        hits = shadow.intersect(origins, toward)
        if environment.lit:
            estimators.add_found_environment(
                values, k, lobes, shares, surface.path, source, environment, hits.face, direction, throughput, density
            )
        if lit_by_lights:
            free = np.where(hits.face >= 0, hits.distance.astype(np.float64) / tracer.scale, np.inf)
            estimators.add_found_lights(
                values, k, lobes, shares, scene, surface, source, free, direction, throughput, density
            )
        if not last:
            surface = surface_at(scene, hits.face, hits.u, hits.v, direction, throughput, surface.path[source])
        shares[:] = 0.0
    return values, covered, rays


class _Nothing:
    """Blocks no ray."""

    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]:
        return np.zeros(len(origins), bool)

    def intersect(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> _Missed:
        zero = np.zeros(len(origins), np.float32)
        return _Missed(np.full(len(origins), -1, np.int32), zero, zero, np.full(len(origins), np.inf, np.float32))


@dataclass(frozen=True)
class _Missed:
    face: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]


def _origins(
    front: NDArray[np.float32], back: NDArray[np.float32], source: NDArray[np.int64], below: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Origins of the rays that leave points `source`, above or below the true surface."""
    if front is back:
        return front[source]
    return np.where(below[:, None], back[source], front[source])

"""The reference: a wavefront path tracer over the same materials, lights and bounces as the precomputed transport.

At every surface point, up to K bounces deep, the light is integrated twice, once by sampling the lights (environment
and local ones) and once by sampling the reflectance, and the two are combined by the power heuristic, exponent 2
[Veach 1995, section 4]. K bounces means K interreflections: layer k holds the light that was reflected k + 1 times.

Samples come in independent passes of `samples_per_pass`, stratified within a pass; the spread of the passes gives the
variance. Every random number hangs on (seed, pixel, pass, sample) alone, so the picture does not depend on how it was
cut into rows, passes or processes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from relightcli.core.brdf.models import TRANSLUCENT, Triple, dot
from relightcli.core.brdf.sampling import evaluate_and_pdf, sample_direction
from relightcli.core.lights.latlong import LatLong, direction_density, lookup, sample
from relightcli.core.transport.camera import Film, approach, film_direction, make_film
from relightcli.core.transport.local_lights import meet_light, sample_light, total_weight
from relightcli.core.transport.sampling import point, stream_key
from relightcli.core.transport.shading import ShadingScene, Surface, surface_at
from relightcli.scene.model import Camera

# Paths in flight: 300 bytes each; larger batches are no faster.
BATCH = 1 << 16

# A light lying flush in a surface is not hidden by it: rays towards local lights end this share before them.
_LIGHT_CLEARANCE = 1e-4


class HitsLike(Protocol):
    """Nearest hits: face (N,) int32, -1 for none; u, v, distance (N,) float32 (distance in the tracer's frame)."""

    @property
    def face(self) -> NDArray[np.int32]: ...
    @property
    def u(self) -> NDArray[np.float32]: ...
    @property
    def v(self) -> NDArray[np.float32]: ...
    @property
    def distance(self) -> NDArray[np.float32]: ...


class TracerLike(Protocol):
    """The part of `relightcli.adapters.rays.Tracer` that is used."""

    center: NDArray[np.float64]
    scale: float

    def to_local(self, points: NDArray[np.floating[Any]]) -> NDArray[np.float32]: ...
    def offset(self, points: NDArray[np.floating[Any]], normals: NDArray[np.floating[Any]]) -> NDArray[np.float32]: ...
    def occluded(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        max_distance: NDArray[np.float32] | None = None,
    ) -> NDArray[np.bool_]: ...
    def intersect(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> HitsLike: ...


@dataclass(frozen=True)
class Tile:
    """Sums over `passes` passes of what each pass measured, for some rows of the picture, float64.

    layers (L, H, W, 3): radiance reflected 1 .. K + 1 times, then, with background, the environment seen directly
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
    tracer: TracerLike,
    environment: LatLong,
    camera: Camera,
    rows: tuple[int, int],
    passes: tuple[int, int],
    samples_per_pass: int,
    bounces: int,
    seed: int = 0,
    background: bool = False,
) -> Tile:
    """Trace rows `rows[0] <= y < rows[1]` of a picture, passes `passes[0] <= p < passes[1]`.

    scene: `shading_scene(...)`; tracer: over the same positions and faces; environment: `make_latlong(...)`, a black
    1 x 1 map for none; samples_per_pass >= 1, best a power of two; bounces K >= 0; background: fill what the camera
    sees past the scene with the environment. Memory: 300 bytes per path, max(BATCH, samples_per_pass) paths.
    """
    film = make_film(camera)
    first, count = rows[0] * film.width, (rows[1] - rows[0]) * film.width
    layers = np.zeros((bounces + 1 + background, count, 3))
    squares = np.zeros((count, 3))
    alpha = np.zeros(count)
    chunk = max(1, BATCH // samples_per_pass)
    rays = 0
    for start in range(0, count, chunk):
        stop = min(start + chunk, count)
        for number in range(*passes):
            paths = _Paths(seed, first + start, stop - start, number, samples_per_pass)
            values, hit, traced = _trace_paths(scene, tracer, environment, film, paths, bounces, background)
            _add_pass(values, hit, samples_per_pass, layers[:, start:stop], squares[start:stop], alpha[start:stop])
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
    tracer: TracerLike,
    environment: LatLong,
    film: Film,
    paths: _Paths,
    bounces: int,
    background: bool,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Radiance per path and layer (N, L, 3), whether its camera ray hit anything (N,), and the number of rays."""
    n = paths.pixels * paths.samples
    keys = _path_keys(paths.seed, paths.first_pixel, paths.pixels, paths.number)
    direction = np.empty((n, 3))
    _camera_rays(film, keys, paths.first_pixel, paths.samples, direction)
    origins = tracer.to_local(approach(film.eye, direction, tracer.center, tracer.scale))
    hits = tracer.intersect(origins, direction.astype(np.float32))
    rays = n
    covered = hits.face >= 0
    values = np.zeros((n, bounces + 1 + background, 3))
    if background:
        _add_background(environment, hits.face, direction, values)
    surface = surface_at(scene, hits.face, hits.u, hits.v, direction, np.ones((n, 3)), np.arange(n))

    lit_by_lights = scene.lights.number > 0
    two_origins = bool((scene.model == TRANSLUCENT).any())
    for k in range(bounces + 1):
        if len(surface.path) == 0:
            break
        front = tracer.offset(surface.position, surface.geometric)
        back = tracer.offset(surface.position, -surface.geometric) if two_origins else front
        if environment.density > 0.0:
            source, below, direction, gain = _sample_environment(
                scene, environment, surface, keys, paths.samples, 3 * k + 1
            )
            blocked = tracer.occluded(_origins(front, back, source, below), direction.astype(np.float32))
            _add_light(values, k, surface.path, source, gain, blocked)
            rays += len(source)
        if lit_by_lights:
            source, below, target, gain = _sample_lights(scene, surface, keys, paths.samples, 3 * k + 2)
            origins = _origins(front, back, source, below)
            reach = np.full(len(source), 1.0 - _LIGHT_CLEARANCE, np.float32)
            blocked = tracer.occluded(origins, tracer.to_local(target) - origins, reach)
            _add_light(values, k, surface.path, source, gain, blocked)
            rays += len(source)

        last = k == bounces
        if last and not (environment.lit or lit_by_lights):
            break
        source, below, direction, throughput, density = _sample_reflection(
            scene, surface, keys, paths.samples, 3 * k + 3
        )
        origins = _origins(front, back, source, below)
        toward = direction.astype(np.float32)
        rays += len(source)
        if last and not lit_by_lights:
            face = np.where(tracer.occluded(origins, toward), 0, -1).astype(np.int32)
            _add_found_environment(values, k, surface.path, source, environment, face, direction, throughput, density)
            break
        hits = tracer.intersect(origins, toward)
        if environment.lit:
            _add_found_environment(
                values, k, surface.path, source, environment, hits.face, direction, throughput, density
            )
        if lit_by_lights:
            free = np.where(hits.face >= 0, hits.distance.astype(np.float64) / tracer.scale, np.inf)
            _add_found_lights(values, k, scene, surface, source, free, direction, throughput, density)
        if not last:
            surface = surface_at(scene, hits.face, hits.u, hits.v, direction, throughput, surface.path[source])
    return values, covered, rays


def _origins(
    front: NDArray[np.float32], back: NDArray[np.float32], source: NDArray[np.int64], below: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Origins of the rays that leave points `source`, above or below the true surface."""
    if front is back:
        return front[source]
    return np.where(below[:, None], back[source], front[source])


@njit(cache=True, error_model="numpy")
def _get(a: Any, i: int) -> Triple:
    return a[i, 0], a[i, 1], a[i, 2]


@njit(cache=True, error_model="numpy")
def _put(a: Any, i: int, x: Triple) -> None:
    a[i, 0], a[i, 1], a[i, 2] = x


@njit(cache=True, error_model="numpy")
def _power_heuristic(p: float, q: float) -> float:
    """Weight of a sample of density p where the other technique has density q: p^2 / (p^2 + q^2). [Veach 1995]"""
    if p == 0.0:
        return 0.0
    r = q / p
    return 1.0 / (1.0 + r * r)


@njit(cache=True, error_model="numpy")
def _path_keys(seed: int, first_pixel: int, pixels: int, number: int) -> Any:
    keys = np.empty(pixels, np.uint64)
    for i in range(pixels):
        keys[i] = stream_key(seed, first_pixel + i, number)
    return keys


@njit(cache=True, error_model="numpy")
def _camera_rays(film: Film, keys: Any, first_pixel: int, samples: int, direction: Any) -> None:
    for i in range(len(keys)):
        y, x = divmod(first_pixel + i, film.width)
        for s in range(samples):
            a, b = point(keys[i], s, 0)
            _put(direction, i * samples + s, film_direction(film, x + a, y + b))


@njit(cache=True, error_model="numpy")
def _add_background(environment: LatLong, face: Any, direction: Any, values: Any) -> None:
    last = values.shape[1] - 1
    for i in range(len(face)):
        if face[i] < 0:
            _put(values[i], last, lookup(environment, _get(direction, i)))


@njit(cache=True, error_model="numpy")
def _passes(model: int, geometric: Triple, shading: Triple, d: Triple) -> bool:
    """Whether light from d can reach the point past its own face: from above both, or through a membrane."""
    return model == TRANSLUCENT or (dot(geometric, d) > 0.0 and dot(shading, d) > 0.0)


@njit(cache=True, error_model="numpy")
def _sample_environment(
    scene: ShadingScene, environment: LatLong, surface: Surface, keys: Any, samples: int, dimension: int
) -> tuple[Any, Any, Any, Any]:
    """Directions to the environment that matter: (point, below its face, direction, radiance if free)."""
    n = len(surface.path)
    source, below = np.empty(n, np.int64), np.empty(n, np.bool_)
    direction, gain = np.empty((n, 3)), np.empty((n, 3))
    m = 0
    for i in range(n):
        pixel, s = divmod(surface.path[i], samples)
        u1, u2 = point(keys[pixel], s, dimension)
        d, radiance, density = sample(environment, u1, u2)
        material = surface.material[i]
        shading, geometric = _get(surface.shading, i), _get(surface.geometric, i)
        if density == 0.0 or not _passes(scene.model[material], geometric, shading, d):
            continue
        f, q = evaluate_and_pdf(
            scene.model[material],
            scene.parameters[material],
            _get(surface.albedo, i),
            shading,
            d,
            _get(surface.viewer, i),
        )
        if f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0:
            continue
        w = _power_heuristic(density, q) / density
        source[m], below[m] = i, dot(geometric, d) < 0.0
        _put(direction, m, d)
        for c in range(3):
            gain[m, c] = surface.throughput[i, c] * f[c] * radiance[c] * w
        m += 1
    return source[:m], below[:m], direction[:m], gain[:m]


@njit(cache=True, error_model="numpy")
def _sample_lights(
    scene: ShadingScene, surface: Surface, keys: Any, samples: int, dimension: int
) -> tuple[Any, Any, Any, Any]:
    """Points of local lights that matter: (point, below its face, light's point in the world, radiance if free)."""
    n = len(surface.path)
    source, below = np.empty(n, np.int64), np.empty(n, np.bool_)
    target, gain = np.empty((n, 3)), np.empty((n, 3))
    m = 0
    for i in range(n):
        pixel, s = divmod(surface.path[i], samples)
        u1, u2 = point(keys[pixel], s, dimension)
        p = _get(surface.position, i)
        d, distance, radiance, density = sample_light(scene.lights, p, u1, u2)
        material = surface.material[i]
        shading, geometric = _get(surface.shading, i), _get(surface.geometric, i)
        if density == 0.0 or not _passes(scene.model[material], geometric, shading, d):
            continue
        f, q = evaluate_and_pdf(
            scene.model[material],
            scene.parameters[material],
            _get(surface.albedo, i),
            shading,
            d,
            _get(surface.viewer, i),
        )
        if f[0] == 0.0 and f[1] == 0.0 and f[2] == 0.0:
            continue
        w = _power_heuristic(density, q) / density
        source[m], below[m] = i, dot(geometric, d) < 0.0
        for c in range(3):
            target[m, c] = p[c] + distance * d[c]
            gain[m, c] = surface.throughput[i, c] * f[c] * radiance[c] * w
        m += 1
    return source[:m], below[:m], target[:m], gain[:m]


@njit(cache=True, error_model="numpy")
def _sample_reflection(
    scene: ShadingScene, surface: Surface, keys: Any, samples: int, dimension: int
) -> tuple[Any, Any, Any, Any, Any]:
    """Directions drawn from the reflectance: (point, below its face, direction, new throughput, density)."""
    n = len(surface.path)
    source, below = np.empty(n, np.int64), np.empty(n, np.bool_)
    direction, throughput, density = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    m = 0
    for i in range(n):
        pixel, s = divmod(surface.path[i], samples)
        u1, u2 = point(keys[pixel], s, dimension)
        material = surface.material[i]
        model, row = scene.model[material], scene.parameters[material]
        shading, geometric = _get(surface.shading, i), _get(surface.geometric, i)
        albedo, view = _get(surface.albedo, i), _get(surface.viewer, i)
        d, usable = sample_direction(model, row, albedo, shading, view, u1, u2)
        if not usable or not _passes(model, geometric, shading, d):
            continue
        f, q = evaluate_and_pdf(model, row, albedo, shading, d, view)
        if not q > 0.0:
            continue
        source[m], below[m], density[m] = i, dot(geometric, d) < 0.0, q
        _put(direction, m, d)
        for c in range(3):
            throughput[m, c] = surface.throughput[i, c] * f[c] / q
        m += 1
    return source[:m], below[:m], direction[:m], throughput[:m], density[:m]


@njit(cache=True, error_model="numpy")
def _add_light(values: Any, layer: int, path: Any, source: Any, gain: Any, blocked: Any) -> None:
    for i in range(len(source)):
        if not blocked[i]:
            for c in range(3):
                values[path[source[i]], layer, c] += gain[i, c]


@njit(cache=True, error_model="numpy")
def _add_found_environment(
    values: Any,
    layer: int,
    path: Any,
    source: Any,
    environment: LatLong,
    face: Any,
    direction: Any,
    throughput: Any,
    density: Any,
) -> None:
    """Add the environment that reflected rays ran into."""
    for i in range(len(source)):
        if face[i] < 0:
            radiance = lookup(environment, _get(direction, i))
            w = _power_heuristic(density[i], direction_density(environment, radiance))
            for c in range(3):
                values[path[source[i]], layer, c] += throughput[i, c] * radiance[c] * w


@njit(cache=True, error_model="numpy")
def _add_found_lights(
    values: Any,
    layer: int,
    scene: ShadingScene,
    surface: Surface,
    source: Any,
    free: Any,
    direction: Any,
    throughput: Any,
    density: Any,
) -> None:
    """Add the local lights that reflected rays crossed on their free length `free` (world units)."""
    for i in range(len(source)):
        j = source[i]
        p, d = _get(surface.position, j), _get(direction, i)
        total = total_weight(scene.lights, p)
        if not total > 0.0:
            continue
        for light in range(len(scene.lights.spheres) + len(scene.lights.rectangles)):
            t, radiance, q = meet_light(scene.lights, light, p, d, total)
            if t < math.inf and t * (1.0 - _LIGHT_CLEARANCE) <= free[i]:
                w = _power_heuristic(density[i], q)
                for c in range(3):
                    values[surface.path[j], layer, c] += throughput[i, c] * radiance[c] * w


@njit(cache=True, error_model="numpy")
def _add_pass(values: Any, hit: Any, samples: int, layers: Any, squares: Any, alpha: Any) -> None:
    """Add the mean over the samples of each pixel to the sums of a tile."""
    for i in range(len(alpha)):
        for c in range(3):
            beauty = 0.0
            for k in range(len(layers)):
                x = 0.0
                for s in range(samples):
                    x += values[i * samples + s, k, c]
                layers[k, i, c] += x / samples
                beauty += x / samples
            squares[i, c] += beauty * beauty
        covered = 0
        for s in range(samples):
            covered += hit[i * samples + s]
        alpha[i] += covered / samples

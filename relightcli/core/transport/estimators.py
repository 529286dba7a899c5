"""The estimators of the path tracer: what is drawn at each surface point, and what is added when the rays come back.

Light that arrives at a point is integrated by two techniques, each drawing one sample: the lights
(`sample_environment`, `sample_lights`) and the reflectance (`sample_reflection`, whose rays are settled by
`add_found_environment` and `add_found_lights`). Every contribution is weighted by the power heuristic, exponent 2, of
the two densities [Veach 1995, section 4]:  F = f |n.l| L / p  *  p^2 / (p^2 + q^2).

Axes: N surface points; M <= N samples that can matter, each with its point's index in `source`.

Light that has been reflected once is in two layers, by the share of the specular lobe in f and by colour: `share` of
samples, `shares` of paths.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from relightcli.core.brdf.models import LAMBERT, TRANSLUCENT, Triple, dot
from relightcli.core.brdf.sampling import evaluate_and_pdf, sample_direction
from relightcli.core.lights.latlong import LatLong, direction_density, lookup, sample
from relightcli.core.transport.camera import Film, film_direction
from relightcli.core.transport.local_lights import LIGHT_CLEARANCE, meet_light, sample_light, total_weight
from relightcli.core.transport.sampling import point, stream_key
from relightcli.core.transport.shading import ShadingScene, Surface


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
def path_keys(seed: int, first_pixel: int, pixels: int, number: int) -> Any:
    """Keys (pixels,) uint64 of the sample points of some pixels in pass `number`."""
    keys = np.empty(pixels, np.uint64)
    for i in range(pixels):
        keys[i] = stream_key(seed, first_pixel + i, number)
    return keys


@njit(cache=True, error_model="numpy")
def camera_rays(film: Film, keys: Any, first_pixel: int, samples: int, direction: Any) -> None:
    """Fill `direction` (pixels * samples, 3) with unit directions through points spread over each pixel."""
    for i in range(len(keys)):
        y, x = divmod(first_pixel + i, film.width)
        for s in range(samples):
            a, b = point(keys[i], s, 0)
            _put(direction, i * samples + s, film_direction(film, x + a, y + b))


@njit(cache=True, error_model="numpy")
def add_background(environment: LatLong, face: Any, direction: Any, values: Any) -> None:
    """Put the environment into the last layer of the paths whose camera ray hit nothing."""
    last = values.shape[1] - 1
    for i in range(len(face)):
        if face[i] < 0:
            _put(values[i], last, lookup(environment, _get(direction, i)))


@njit(cache=True, error_model="numpy")
def _passes(model: int, geometric: Triple, shading: Triple, d: Triple) -> bool:
    """Whether light from d can reach the point past its own face: from above both, or through a membrane."""
    return model == TRANSLUCENT or (dot(geometric, d) > 0.0 and dot(shading, d) > 0.0)


@njit(cache=True, error_model="numpy")
def _share(model: int, albedo: Triple, shading: Triple, d: Triple, f: Triple, c: int) -> float:
    """Part of the specular lobe in f, which is reflectance times |n.l|."""
    if model in (LAMBERT, TRANSLUCENT) or f[c] <= 0.0:
        return 0.0
    return min(max(1.0 - albedo[c] * max(dot(shading, d), 0.0) / (math.pi * f[c]), 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def sample_environment(
    scene: ShadingScene, environment: LatLong, surface: Surface, keys: Any, samples: int, dimension: int, shares: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """Directions to the environment that matter: (point, below its face, direction, radiance if free, share).

    shares (paths, 3): those to take; of no paths: they are found here.
    """
    n = len(surface.path)
    source, below = np.empty(n, np.int64), np.empty(n, np.bool_)
    direction, gain, share = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
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
            if len(shares):
                share[m, c] = shares[surface.path[i], c]
            else:
                share[m, c] = _share(scene.model[material], _get(surface.albedo, i), shading, d, f, c)
        m += 1
    return source[:m], below[:m], direction[:m], gain[:m], share[:m]


@njit(cache=True, error_model="numpy")
def sample_lights(
    scene: ShadingScene, surface: Surface, keys: Any, samples: int, dimension: int, shares: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """Points of local lights that matter: (point, below its face, light's point in the world, radiance if free,
    share). shares as for `sample_environment`."""
    n = len(surface.path)
    source, below = np.empty(n, np.int64), np.empty(n, np.bool_)
    target, gain, share = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
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
            if len(shares):
                share[m, c] = shares[surface.path[i], c]
            else:
                share[m, c] = _share(scene.model[material], _get(surface.albedo, i), shading, d, f, c)
        m += 1
    return source[:m], below[:m], target[:m], gain[:m], share[:m]


@njit(cache=True, error_model="numpy")
def sample_reflection(
    scene: ShadingScene, surface: Surface, keys: Any, samples: int, dimension: int, shares: Any
) -> tuple[Any, Any, Any, Any, Any]:
    """Directions drawn from the reflectance: (point, below its face, direction, new throughput, density).

    shares (paths, 3): set, unless of no paths.
    """
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
            if len(shares):
                shares[surface.path[i], c] = _share(model, albedo, shading, d, f, c)
        m += 1
    return source[:m], below[:m], direction[:m], throughput[:m], density[:m]


@njit(cache=True, error_model="numpy")
def add_light(values: Any, layer: int, lobes: int, path: Any, source: Any, gain: Any, blocked: Any, share: Any) -> None:
    """Add the sampled light that is not blocked, to `layer` and by its share to the layer `lobes`."""
    for i in range(len(source)):
        if not blocked[i]:
            for c in range(3):
                values[path[source[i]], layer, c] += gain[i, c] * (1.0 - share[i, c])
                values[path[source[i]], lobes, c] += gain[i, c] * share[i, c]


@njit(cache=True, error_model="numpy")
def add_found_environment(
    values: Any,
    layer: int,
    lobes: int,
    shares: Any,
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
            p = path[source[i]]
            for c in range(3):
                x = throughput[i, c] * radiance[c] * w
                values[p, layer, c] += x * (1.0 - shares[p, c])
                values[p, lobes, c] += x * shares[p, c]


@njit(cache=True, error_model="numpy")
def add_found_lights(
    values: Any,
    layer: int,
    lobes: int,
    shares: Any,
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
            if t < math.inf and t * (1.0 - LIGHT_CLEARANCE) <= free[i]:
                w = _power_heuristic(density[i], q)
                path = surface.path[j]
                for c in range(3):
                    x = throughput[i, c] * radiance[c] * w
                    values[path, layer, c] += x * (1.0 - shares[path, c])
                    values[path, lobes, c] += x * shares[path, c]


@njit(cache=True, error_model="numpy")
def add_pass(values: Any, hit: Any, samples: int, layers: Any, squares: Any, alpha: Any) -> None:
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

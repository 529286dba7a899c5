"""How much of a picture's light an effect carries: a few thousand paths in small pictures, with a confidence bound.

Every view is traced twice, with different random numbers. With A and B what the two found of an effect at pixel p, and
A', B' of all light, A_p B_p has the square of the effect's light as its mean, noise and all, so that

    share = (sum_p A_p B_p / sum_p A'_p B'_p)^(1/2)

is the relative RMS that leaving the effect out costs. Its bounds take CONFIDENCE standard errors of both sums. The
largest over all views and skies counts. Adjustable materials are as bright as they can be set.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relightcli.core.lights.latlong import LatLong, make_latlong
from relightcli.core.lights.sky import sky_latlong
from relightcli.core.transport.path_tracer import trace_rows
from relightcli.core.transport.shading import ShadingScene
from relightcli.core.transport.tracer import Tracer
from relightcli.scene.model import Camera, Material

PIXELS = 384  # of a view, about
SAMPLES = 8  # paths a pixel and pass, in each of the two runs
PASSES = ((0, 1), (1, 3), (3, 7))  # one, and more where one does not tell
BOUNCES = 4  # that are traced; what comes after them is extrapolated
CONFIDENCE = 2.33  # standard errors: one sided, 99 %
MOST_VIEWS = 3
ROUND = (45.0, 165.0, 285.0)  # azimuths of views of a scene without cameras
STEEPEST = 0.95  # ratio of one bounce to the one before it, for what is extrapolated


@dataclass(frozen=True)
class Share:
    """Part of the light that an effect carries: the estimate, its bounds, and where the upper one was found."""

    share: float
    bound: float
    least: float
    where: str


NOTHING = Share(0.0, 0.0, 0.0, "anywhere")


def brightest(materials: Iterable[Material]) -> list[Material]:
    """The materials; of adjustable ones the diffuse albedo is what their lobes leave of 1, or as it is if that is
    more."""
    out = []
    for m in materials:
        if not m.adjustable:
            out.append(m)
            continue
        rest = np.maximum(1.0 - np.maximum(m.specular, m.transmittance), m.diffuse)
        out.append(replace(m, diffuse=(float(rest[0]), float(rest[1]), float(rest[2]))))
    return out


def views(cameras: Sequence[Camera], positions: NDArray[np.float64], faces: NDArray[np.int32]) -> list[Camera]:
    """Small pictures of the scene's first cameras, or from around it if it has none."""
    chosen = list(cameras[:MOST_VIEWS])
    if not chosen:
        used = positions[np.unique(faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        middle, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-300)
        for azimuth in map(math.radians, ROUND):
            away = np.array([math.sin(azimuth), 0.7, math.cos(azimuth)])
            eye = middle + 3.2 * radius * away / np.linalg.norm(away)
            chosen.append(Camera("around", _triple(eye), _triple(middle), fov=38.0, size=(4, 3)))
    out = []
    for camera in chosen:
        width, height = camera.size
        scale = math.sqrt(PIXELS / (width * height))
        out.append(replace(camera, size=(max(1, round(width * scale)), max(1, round(height * scale)))))
    return out


def skies(lamps: bool) -> list[tuple[str, LatLong]]:
    """Even light, suns of three heights from three sides; and lamps alone where there are any."""
    size = (128, 256)
    out = [
        ("even light", np.ones((1, 1, 3), np.float32)),
        ("sun at 15 degrees", sky_latlong(15.0, 30.0, size=size)),
        ("sun at 35 degrees", sky_latlong(35.0, 150.0, size=size)),
        ("sun at 60 degrees", sky_latlong(60.0, 270.0, size=size)),
    ]
    if lamps:
        out.append(("lamps alone", np.zeros((1, 1, 3), np.float32)))
    return [(name, make_latlong(radiance)) for name, radiance in out]


def tails(scene: ShadingScene, tracer: Tracer, cameras: Sequence[Camera], allowed: float, seed: int = 0) -> list[Share]:
    """What is lost by ending after k interreflections, k = 0 .. BOUNCES; the last is extrapolated.

    Views under skies that do not tell yet how many it takes to lose no more than `allowed` are traced on.
    """
    looks = [_Look(scene, tracer, camera, sky, where, seed) for camera, sky, where in _all(scene, cameras)]
    for first, last in PASSES:
        least = max(look.needed(allowed)[0] for look in looks) if first else -1
        for look in looks:
            if look.needed(allowed)[1] > least:
                look.trace(first, last)
    worst = [NOTHING] * (BOUNCES + 1)
    for look in looks:
        worst = [larger(*pair) for pair in zip(worst, look.tails(), strict=True)]
    return worst


class _Look:
    """One view under one sky: two independent runs of it, which go on where they stopped."""

    def __init__(
        self, scene: ShadingScene, tracer: Tracer, camera: Camera, sky: LatLong, where: str, seed: int
    ) -> None:
        self.setting = (scene, tracer, sky, camera)
        self.where = where
        self.seed = seed
        self.passes = 0
        self.runs = [np.zeros(0), np.zeros(0)]

    def trace(self, first: int, last: int) -> None:
        if first != self.passes:
            return  # was clear before
        more = [_trace(*self.setting, BOUNCES, self.seed + k, True, (first, last)) for k in (0, 1)]
        self.runs = [a + b if first else b for a, b in zip(self.runs, more, strict=True)]
        self.passes = last

    def tails(self) -> list[Share]:
        whole = [run.sum(axis=0) for run in self.runs]
        last = share_of(self.runs[0][BOUNCES], self.runs[1][BOUNCES], whole[0], whole[1], self.where)
        mean = [sum(float(run[k].sum()) for run in self.runs) for k in (BOUNCES - 1, BOUNCES)]
        ratio = min(mean[1] / mean[0], STEEPEST) if mean[0] > 0.0 else 0.0
        grown = ratio / (1.0 - ratio)
        out = []
        for k in range(BOUNCES):
            rest = [run[k + 1 : BOUNCES].sum(axis=0) + run[BOUNCES] * (1.0 + grown) for run in self.runs]
            out.append(share_of(rest[0], rest[1], whole[0], whole[1], self.where))
        return [*out, Share(last.share * grown, last.bound * grown, last.least * grown, self.where)]

    def needed(self, allowed: float) -> tuple[int, int]:
        """How many interreflections it takes at least, and at most, as far as is known."""
        if not self.passes:
            return 0, BOUNCES + 1
        tails = self.tails()

        def first(values: list[float]) -> int:
            return next((k for k, v in enumerate(values) if v <= allowed), BOUNCES + 1)

        return first([t.least for t in tails]), first([t.bound for t in tails])


def shadows(scene: ShadingScene, tracer: Tracer, cameras: Sequence[Camera], seed: int = 0) -> Share:
    """What is lost by letting light through everything."""
    worst = NOTHING
    for camera, sky, where in _all(scene, cameras):
        pair = [_trace(scene, tracer, sky, camera, 0, seed + run, True).sum(axis=0) for run in (0, 1)]
        through = [_trace(scene, tracer, sky, camera, 0, seed + run, False).sum(axis=0) for run in (0, 1)]
        lost = [a - b for a, b in zip(through, pair, strict=True)]
        worst = larger(worst, share_of(lost[0], lost[1], pair[0], pair[1], where))
    return worst


def _all(scene: ShadingScene, cameras: Sequence[Camera]) -> list[tuple[Camera, LatLong, str]]:
    """Every view under every sky, with its name."""
    lights = skies(scene.lights.number > 0)
    return [(camera, sky, f"{_name(camera)}, {name}") for camera in cameras for name, sky in lights]


def _trace(
    scene: ShadingScene,
    tracer: Tracer,
    sky: LatLong,
    camera: Camera,
    bounces: int,
    seed: int,
    blocks: bool,
    passes: tuple[int, int] = (0, 1),
) -> NDArray[np.float64]:
    """Layers (bounces + 2, pixels, 3): direct diffuse, each interreflection, direct specular. Sums over the passes."""
    tile = trace_rows(scene, tracer, sky, camera, (0, camera.size[1]), passes, SAMPLES, bounces, seed, blocks=blocks)
    return tile.layers.reshape(bounces + 2, -1, 3)


def share_of(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    whole_a: NDArray[np.float64],
    whole_b: NDArray[np.float64],
    where: str,
) -> Share:
    found, spread = _mean_square(a, b)
    light, wide = _mean_square(whole_a, whole_b)
    if not whole_a.any():
        return NOTHING
    share = math.sqrt(max(found, 0.0) / max(light, 1e-300))
    bound = math.sqrt(max(found + spread, 0.0) / (light - wide)) if light > wide else math.inf
    most = light + wide  # 0 where the two runs have lit no pixel both
    least = math.sqrt(max(found - spread, 0.0) / most) if most > 0.0 else 0.0
    return Share(share, bound if found or spread else 0.0, least, where)


def _mean_square(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, float]:
    """sum A B, and CONFIDENCE standard errors of it: the smaller of two estimates.

    With s^2 = (A - B)^2 / 2 the variance of A B is 2 A B s^2 + s^4; colours come of the same paths, so that their
    errors add up. A single path of great weight can make that far too large, because its square counts. The other one
    is the spread of A B over the pixels, which has what the picture shows in it, not only noise.
    """
    product, variance = a * b, 0.5 * (a - b) ** 2
    noise = np.sqrt(2.0 * np.maximum(product, 0.0) * variance + variance**2).sum(axis=1)
    spread = math.sqrt(len(a)) * float(product.sum(axis=1).std())
    return float(product.sum()), CONFIDENCE * min(float(np.linalg.norm(noise)), spread)


def larger(a: Share, b: Share) -> Share:
    """The one with the larger bound."""
    return b if b.bound > a.bound else a


def _name(camera: Camera) -> str:
    return "a view from around" if camera.name == "around" else f"camera {camera.name}"


def _triple(v: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])

"""The error of light at receivers, measured: some rows of pictures against two runs of the path tracer.

With S what the receivers give at a pixel and A, B what two runs find there, (S - A)(S - B) has the square of the error
as its mean, whatever the noise of the runs (`plan.pilot`). Views and skies are not those of the pilot.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.lights.latlong import make_latlong
from relightcli.core.lights.sky import sky_latlong
from relightcli.core.shade import picture, primary
from relightcli.core.transport import visibility
from relightcli.core.transport.camera import make_film
from relightcli.core.transport.light_visibility import light_bits
from relightcli.core.transport.local_lights import pack_lights
from relightcli.core.transport.path_tracer import trace_rows
from relightcli.core.transport.receivers import Receivers, receivers_of_vertices
from relightcli.core.transport.shading import shading_scene
from relightcli.plan.pilot import NOTHING, Share, larger, share_of, views
from relightcli.run.accounting import Meter
from relightcli.scene.model import Camera, Geometry, Material, Scene
from relightcli.stages.lighting import LightingStore, together

PIXELS = 2048  # of a picture that are compared, about
STRIP = 4  # rows that are taken together, so that outlines are found
SAMPLES = 8  # paths a pixel that are traced at least, in each of the two runs
MOST_TIMES = 64  # as many of them, where those do not tell
MISSED = 16  # as many at least before anything counts as missed: rare bright paths make few of them look sure of it
TELLS = 0.5  # of the error to keep: bounds that lie nearer to each other are near enough
TURN, LIFT = 12.0, 7.0  # degrees from a camera of the scene to a view of the check: round the target, and up
STEEPEST = 80.0  # degrees above the target to which a view is lifted
MORE = 3  # interreflections that the truth has beyond the store's
MOST_VIEWS = 2
MAP = (128, 256)  # rows and columns of a sky
GLOW, DUSK = 8.0, 12.0  # degrees
TRIAL_SUNS = ((15, 30), (15, 150), (15, 270), (35, 90), (60, 210))  # degrees above the horizon, and of azimuth
HOPELESS, GAIN = 2.0, 0.1

Sky = NDArray[np.float32]


def check_skies() -> dict[str, Sky]:
    """Skies that nothing is chosen by. Low suns from all sides: what they light from behind is dark in a picture and
    full of shadows."""
    return {
        "sun at 12 degrees": sky_latlong(12.0, 85.0, size=MAP),
        "sun at 50 degrees": sky_latlong(50.0, 230.0, size=MAP),
        "overcast": sky_latlong(30.0, size=MAP, overcast=True),
        "sun at 20 degrees": sky_latlong(20.0, 205.0, size=MAP),
        "glow": _ring(3.0, GLOW, 0.1, 0.5),
        "another sun at 12 degrees": sky_latlong(12.0, 325.0, size=MAP),
        "dusk": _ring(-4.0, DUSK, 0.03, 2.6),
    }


def trial_skies() -> dict[str, Sky]:
    """Skies that settings of direct light are chosen by."""
    suns = {f"sun at {up} degrees from {side}": sky_latlong(up, side, size=MAP) for up, side in TRIAL_SUNS}
    return {**suns, "dawn": _ring(-5.0, DUSK, 0.03, 4.7)}


def _ring(middle: float, wide: float, backdrop: float, side: float) -> Sky:
    """A dim sky with a bright ring about the horizon, warm on one side: latitudes in degrees. Narrow enough to fall
    between vertices that lobes show it at, too wide to be taken apart as a sun is; light that comes in level, or from
    below, finds its way between vertices where nothing else does."""
    height, width = MAP
    latitude = (180.0 * (0.5 - (np.arange(height) + 0.5) / height))[:, None]
    longitude = math.pi * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)
    ring = np.exp(-(((latitude - middle) / wide) ** 2))[..., None]
    warm = (0.5 + 0.5 * np.cos(longitude + side))[:, None]
    colour = warm * np.array([3.0, 1.5, 0.5]) + (1.0 - warm) * np.array([0.6, 0.8, 1.5])
    return (backdrop + ring * colour).astype(np.float32)  # type: ignore[no-any-return]


def check_views(scene: Scene, geometry: Geometry, only: str | None) -> list[Camera]:
    """Views that nothing is chosen by: the scene's, turned and lifted; of a store of pixels the one that it is for."""
    if only is not None:
        return [scene.cameras[only]]
    cameras = list(scene.cameras.values())[:MOST_VIEWS]
    if not cameras:
        return [replace(c, size=(64, 48)) for c in views([], geometry.positions, geometry.faces)[:MOST_VIEWS]]
    turned = []
    for camera in cameras:
        x, y, z = np.subtract(camera.eye, camera.target)
        distance = math.hypot(x, y, z)
        round_ = math.atan2(x, z) + math.radians(TURN)
        up = math.asin(y / distance)
        up = max(up, min(up + math.radians(LIFT), math.radians(STEEPEST)))
        away = (math.sin(round_) * math.cos(up), math.sin(up), math.cos(round_) * math.cos(up))
        eye = np.add(camera.target, distance * np.array(away))
        turned.append(replace(camera, eye=(float(eye[0]), float(eye[1]), float(eye[2]))))
    return turned


def edited(materials: dict[str, Material]) -> dict[str, Material]:
    """The materials after an edit: what is adjustable has its colours turned round."""
    return {
        name: replace(m, diffuse=m.diffuse[1:] + m.diffuse[:1], specular=m.specular[1:] + m.specular[:1])
        if m.adjustable
        else m
        for name, m in materials.items()
    }


def edit_of(materials: dict[str, Material], editable: set[str]) -> dict[str, Material] | None:
    """`edited`, of those that the light can be edited of; None where that changes nothing."""
    changed = {name: edited({name: m})[name] if name in editable else m for name, m in materials.items()}
    return changed if changed != materials else None


@dataclass(frozen=True)
class Strips:
    """Rows of a camera's picture, and how receivers make them: one matrix for each range of rows."""

    camera: Camera
    rows: list[tuple[int, int]]
    matrices: list[picture.PixelMatrix]

    def used(self, count: int) -> NDArray[np.bool_]:
        """Which of `count` receivers the strips need."""
        return np.any([m.used(count) for m in self.matrices], axis=0)  # type: ignore[no-any-return]

    def renumbered(self, new: NDArray[np.int64]) -> Strips:
        """The same strips of receivers that got other numbers."""
        return replace(self, matrices=[replace(m, receiver=new[m.receiver].astype(np.int32)) for m in self.matrices])

    def pixels(self, diffuse: NDArray[np.float32], specular: NDArray[np.float32] | None) -> NDArray[np.float64]:
        """Radiance (n, 3) of the strips' pixels, of that of the receivers."""
        return np.concatenate([picture.assemble(m, diffuse, specular, 1) for m in self.matrices]).astype(np.float64)


def rows_of(camera: Camera) -> list[tuple[int, int]]:
    """Strips of rows, evenly spread, with about PIXELS pixels together."""
    width, height = camera.size
    strips = max(1, PIXELS // (width * STRIP))
    if strips * STRIP >= height:
        return [(0, height)]
    tops = ((np.arange(strips) + 0.5) * height / strips - 0.5 * STRIP).astype(int)
    return [(int(top), int(top) + STRIP) for top in tops]


def vertex_strips(
    geometry: Geometry,
    tracer: Tracer,
    camera: Camera,
    front: NDArray[np.int32],
    back: NDArray[np.int32],
    buried: NDArray[np.bool_],
) -> Strips:
    """Strips of a picture whose receivers are vertices; see `picture.vertex_matrix`."""
    normals = primary.face_normals(geometry.positions, geometry.faces)
    film = make_film(camera)
    base = primary.TEXTURE_GRID if geometry.textures else primary.BASE_GRID
    rows, matrices = rows_of(camera), []
    for top, bottom in rows:
        part = film._replace(corner=film.corner + top * film.step_y, height=bottom - top)
        samples = primary.see(tracer, part, geometry.face_object, normals, base)
        count = film.width * (bottom - top)
        matrices.append(picture.vertex_matrix(geometry, samples, normals, front, back, buried, count))
    return Strips(camera, rows, matrices)


def pixel_strips(
    camera: Camera, pixel: NDArray[np.int32], weight: NDArray[np.float32], texture: NDArray[np.float32]
) -> Strips:
    """Strips of a picture whose pixels are the receivers; see `picture.sample_matrix`."""
    width, height = camera.size
    whole = picture.sample_matrix(pixel, weight, texture, width * height)
    rows, matrices = rows_of(camera), []
    for top, bottom in rows:
        start = whole.start[top * width : bottom * width + 1]
        part = slice(start[0], start[-1])
        matrices.append(
            picture.PixelMatrix(start - start[0], whole.receiver[part], whole.weight[part], whole.texture[part])
        )
    return Strips(camera, rows, matrices)


class Draft:
    """A store that is still being written, to be read by `LightingStore`."""

    def __init__(self, writer: formats.Writer) -> None:
        self.writer = writer
        self.kind, self.path = "transfer", writer.path
        self.settings, self.attrs, self.layouts, self.read = writer.settings, writer.attrs, writer.layouts, writer.read

    def names(self) -> list[str]:
        return sorted(self.layouts)

    def __contains__(self, name: object) -> bool:
        return name in self.layouts

    def array(self, name: str) -> Any:
        return formats.worker_array(self.writer.partial_path, name)


class Trial(LightingStore):
    """Some receivers on vertices, with their visibility traced at once and kept in memory."""

    def __init__(
        self,
        scene: Scene,
        geometry: Geometry,
        points: Receivers,
        buried: NDArray[np.bool_],
        tracer: Tracer,
        resolution: int,
        refine: int,
        seed: int,
    ) -> None:
        self.scene, self.geometry = scene, geometry
        self.threads = 1
        self.position, self.normal, self.object = points.position, points.normal, points.object
        self.side, self.vertex = points.side, points.vertex
        self.resolution, self.basis, self.bounces, self.pixels = resolution, "visibility", 0, 0
        self._buried = buried
        self._coated, self._cubes = None, []
        lamps = pack_lights(scene.lights.values())
        lit: dict[str, Any] = {}
        if lamps.number:
            lit["lights/bits"] = light_bits(tracer, lamps, points.position, points.normal)[0]
        self.store: Any = _Memory(lit)
        clock = time.perf_counter()
        self._seen_bits = visibility.trace_visibility(
            tracer, points.position, points.normal, resolution, refine, seed
        ).bits
        self.seconds = time.perf_counter() - clock

    @property
    def camera_name(self) -> str | None:
        return None

    def buried(self) -> NDArray[np.bool_]:
        return self._buried

    def blocks(
        self, first: int = 0, last: int | None = None, needed: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        last = len(self) if last is None else last
        yield slice(first, last), self._seen_bits[first:last]


class _Memory(dict[str, Any]):
    """Arrays by name."""

    def read(self, name: str) -> Any:
        return self[name]


@dataclass
class _Run:
    """Pixels of what was traced: `times` SAMPLES paths each, in `passes` passes that double what there was before.

    A pass's points are stratified, so that its error falls faster than with the root of their number: passes are
    weighted with the square of it.
    """

    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(()))
    weight: float = 0.0
    times: int = 0
    passes: int = 0


@dataclass(frozen=True)
class Judge:
    """The path tracer on the scene as it is, before faces were cut. traced: what it has found, to be asked again; lit:
    what each picture's light took that was held against it (`run.accounting.Meter`)."""

    scene: Scene
    geometry: Geometry
    tracer: Tracer
    traced: dict[tuple[Camera, str, int, int, int], _Run] = field(default_factory=dict)
    lit: list[dict[str, float]] = field(default_factory=list)

    def error(
        self,
        lighting: LightingStore,
        strips: Sequence[Strips],
        skies: dict[str, Sky],
        bounces: int,
        truth: int,
        edit: dict[str, Material] | None,
        most: float,
        seed: int = 1000,
    ) -> Share:
        """The largest error of the receivers' light with `bounces` against `truth` interreflections. Truth whose noise
        hides whether that is more than `most` is traced on. edit: materials for every second sky."""
        worst = NOTHING
        changes = [self.scene.materials]
        if edit is not None:
            changes.append(edit)
        for view in strips:
            eye = np.array(view.camera.eye)
            d = eye - lighting.position
            towards = (d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)).astype(np.float32)
            active = view.used(len(lighting))
            for number, (name, sky) in enumerate(skies.items()):
                materials = changes[number % len(changes)]
                meter = Meter()
                light = together(lighting.exit_radiance(sky, 0.0, materials, towards, active, None, bounces))
                self.lit.append(meter.read())
                ours = view.pixels(light.diffuse, light.specular)
                where = f"camera {view.camera.name}, {name}{', edited' if number % len(changes) else ''}"
                keys = [(view.camera, name, number % len(changes), truth, run) for run in (seed, seed + 1)]
                times = 1
                while True:
                    a, b = (self._mean(key, times, view, sky, materials) for key in keys)
                    share = share_of(ours - a, ours - b, a, b, where)
                    missed = share.least > most and times >= MISSED
                    clear = missed or share.bound <= most or share.bound - share.least <= TELLS * most
                    if clear or times >= MOST_TIMES:
                        break
                    times *= 2
                worst = larger(worst, share)
        return worst

    def _mean(
        self,
        key: tuple[Camera, str, int, int, int],
        times: int,
        view: Strips,
        sky: Sky,
        materials: dict[str, Material],
    ) -> NDArray[np.float64]:
        """A run's pixels, of that many times SAMPLES paths at least; it goes on where it stopped."""
        run = self.traced.setdefault(key, _Run())
        while run.times < times:
            more = max(1, run.times)
            found = self.trace(view, sky, materials, key[3], key[4], run.passes, more * SAMPLES)
            run.total, run.weight = run.total + more**2 * found, run.weight + more**2
            run.times, run.passes = run.times + more, run.passes + 1
        return run.total / run.weight

    def trace(
        self,
        view: Strips,
        sky: Sky,
        materials: dict[str, Material],
        bounces: int,
        seed: int,
        number: int = 0,
        samples: int = SAMPLES,
    ) -> NDArray[np.float64]:
        """The strips' pixels, (n, 3), of pass `number` of a run."""
        shading = shading_scene(self.geometry, list(materials.values()), self.scene.lights.values())
        environment = make_latlong(sky)
        out, passes = [], (number, number + 1)
        for rows in view.rows:
            tile = trace_rows(shading, self.tracer, environment, view.camera, rows, passes, samples, bounces, seed)
            out.append(tile.layers.sum(axis=0).reshape(-1, 3))
        return np.concatenate(out)


def trial(
    judge: Judge,
    geometry: Geometry,
    points: Receivers,
    buried: NDArray[np.bool_],
    strips: Sequence[Strips],
    resolutions: Sequence[int],
    refine: int,
    skies: dict[str, Sky],
    most: float,
    seed: int,
) -> list[tuple[int, Share]]:
    """The error of direct light by resolution of the light, from coarse to fine, until it is at most `most`, or there
    is no hope of that: it is HOPELESS times that, and two resolutions more have not taken a GAIN of it away.

    geometry: the mesh that the receivers `points` are on; only receivers that the strips need are traced."""
    tracer = Tracer(geometry.positions, geometry.faces)
    used = np.any([s.used(len(points)) for s in strips], axis=0)
    front, back = receivers_of_vertices(points.vertex, points.side, len(geometry.positions))
    other = np.where(points.side > 0, back[points.vertex], front[points.vertex])
    used[other[used & (points.vertex >= 0) & (other >= 0)]] = True  # light may come through from there
    rows = np.flatnonzero(used)
    strips = [s.renumbered(np.cumsum(used) - 1) for s in strips]
    out: list[tuple[int, Share]] = []
    for resolution in resolutions:
        lighting = Trial(judge.scene, geometry, points.at(rows), buried[rows], tracer, resolution, refine, seed)
        out.append((resolution, judge.error(lighting, strips, skies, 0, 0, None, most)))
        share = out[-1][1].share
        if share <= most or (len(out) > 2 and share > max(HOPELESS * most, (1.0 - GAIN) * out[-3][1].share)):
            break
    return out

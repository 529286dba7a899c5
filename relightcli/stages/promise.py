"""The promise of `precompute --tolerance`: a resolution of light that keeps it, and the error measured at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import mean, median
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.transport.receivers import receivers_of_vertices
from relightcli.errors import NumericalError
from relightcli.plan import pilot
from relightcli.scene.model import Camera, Geometry, Scene
from relightcli.stages.lighting import LightingStore
from relightcli.stages.measured_error import (
    GAIN,
    MORE,
    Draft,
    Judge,
    Strips,
    check_skies,
    check_views,
    edit_of,
    pixel_strips,
    trial,
    trial_skies,
    vertex_strips,
)
from relightcli.stages.promise_moving import check_moved
from relightcli.stages.receiver_setup import MOST_PIXEL_GRID, PixelReceivers

if TYPE_CHECKING:
    from relightcli.core.transport.receivers import Receivers
    from relightcli.stages.precompute_config import Config
    from relightcli.stages.prepare import Prepared

RESOLUTIONS = (16, 32, 64, 128)  # to choose from
GRIDS = (1, 2, 4, MOST_PIXEL_GRID)  # of receivers along a pixel's side, to choose from
MOST_RECEIVERS = 5_000_000  # of a picture with a grid that is chosen: 4 x 4 in each of 640 x 480
Receiving = Callable[[int], "tuple[Receivers | PixelReceivers, NDArray[np.bool_] | None]"]  # by grid of pixels
LEAST = 0.01  # of the tolerance: errors of a trial below it say no more than that they are small
AGAIN = 1.01  # times more care than before is worth another attempt: less comes from settings that stayed the same
DIRECT = 0.8  # of the tolerance: what direct light may be off by; the square of the rest is for what is left out


@dataclass(frozen=True)
class Decided:
    """What has come of earlier attempts to keep a tolerance: whether large faces stay "whole" or are "cut" (None: not
    known yet), and how many times more direct light erred in the check than in the trial."""

    faces: str | None = None
    care: float = 1.0

    def direct(self, promise: float) -> float:
        """What direct light may be off by in the trial."""
        return DIRECT * promise / self.care


UNDECIDED = Decided()


def _strips(
    scene: Scene,
    geometry: Geometry,
    receivers: Receivers | PixelReceivers,
    buried: NDArray[np.bool_] | None,
    cameras: list[Camera],
) -> list[Strips]:
    """Some rows of pictures made from the receivers."""
    if isinstance(receivers, PixelReceivers):
        return [pixel_strips(camera, receivers.pixel, receivers.weight, receivers.texture) for camera in cameras]
    front, back = receivers_of_vertices(receivers.vertex, receivers.side, len(geometry.positions))
    tracer = Tracer(geometry.positions, geometry.faces)
    hidden = np.zeros(len(receivers), bool) if buried is None else buried
    return [vertex_strips(geometry, tracer, camera, front, back, hidden) for camera in cameras]


def camera_of(config: Config) -> str | None:
    """The camera whose pixels are to be the receivers; None for vertices."""
    return None if config.receivers == "vertices" else config.receivers.partition(":")[2]


@dataclass(frozen=True)
class Tried:
    """A resolution of light and, of receivers on pixels, their grid; the error of direct light with them; the seconds
    and cpu_seconds that the light of a picture takes; how many times the least paths it took to tell, in the mean."""

    resolution: int
    grid: int
    error: pilot.Share
    lit: dict[str, float]
    times: float


def try_settings(config: Config, judge: Judge, geometry: Geometry, receivers_of: Receiving, most: float) -> list[Tried]:
    """Errors of direct light by grid of pixels and resolution, up to one of at most `most`, in the pilot's views.
    judge: of the scene as it is; geometry: the mesh that receivers are on.

    What was asked for is all that is tried of it. A finer grid is tried from the coarsest resolution on that was as
    good as any with the one before."""
    resolutions = [r for r in RESOLUTIONS if config.refine * 4 <= r]
    if config.light_resolution is not None:
        resolutions = [config.light_resolution]
    only = camera_of(config)
    grids: tuple[int, ...] = (config.grid,)
    if config.pixel_grid is None and only:
        width, height = judge.scene.cameras[only].size
        grids = tuple(grid for grid in GRIDS if grid == 1 or grid**2 * width * height <= MOST_RECEIVERS)
    out: list[Tried] = []
    for grid in grids:
        receivers, buried = receivers_of(grid)
        judge.lit.clear()
        found = _try_resolutions(config, judge, geometry, receivers, buried, resolutions, most)
        lit = {key: median(one[key] for one in judge.lit) for key in ("seconds", "cpu_seconds")}
        times = mean(run.times for run in judge.traced.values())
        out += [Tried(resolution, grid, error, lit, times) for resolution, error in found]
        if out[-1].error.share <= most:
            break
        least = min(error.share for _, error in found)
        first = next(resolution for resolution, error in found if error.share <= (1.0 + GAIN) * least)
        resolutions = [r for r in resolutions if r >= first]
    return out


def _try_resolutions(
    config: Config,
    judge: Judge,
    geometry: Geometry,
    receivers: Receivers | PixelReceivers,
    buried: NDArray[np.bool_] | None,
    resolutions: Sequence[int],
    most: float,
) -> list[tuple[int, pilot.Share]]:
    only, scene, source = camera_of(config), judge.scene, judge.geometry
    cameras = [scene.cameras[only]] if only else list(scene.cameras.values())[: pilot.MOST_VIEWS]
    if not cameras:
        cameras = check_views(scene, source, None)
    points = receivers.points if isinstance(receivers, PixelReceivers) else receivers
    return trial(
        judge,
        geometry,
        points,
        np.zeros(len(points), bool) if buried is None else buried,
        _strips(scene, geometry, receivers, buried, cameras),
        resolutions,
        config.refine,
        trial_skies(),
        most,
        config.seed,
    )


def choose(tried: list[Tried], most: float) -> Tried:
    """The coarsest settings whose direct light errs by at most `most`; where none does, the coarsest that are as good
    as any: what is wrong then does not come from them, and finer ones would only cost."""
    most = max(most, (1.0 + GAIN) * min(one.error.share for one in tried))
    return next(one for one in tried if one.error.share <= most)


def direct_keeps(tried: Sequence[Tried], most: float) -> bool:
    """Whether direct light errs by at most `most` with any of the settings."""
    return any(one.error.share <= most for one in tried)


def need_reach(config: Config, promise: float, scene: Scene, tried: Sequence[Tried], finer_helps: bool) -> None:
    """Raises NumericalError where direct light alone misses the tolerance beyond doubt, with all that was tried."""
    missed = out_of_reach(promise, tried)
    if missed is not None and not config.allow_miss:
        knob = _sharper(config, scene, tried[-1].resolution, finer_helps)
        raise NumericalError(
            f"{config.output}: {missed}. What would help: {knob}. Nothing was simulated; the same command with "
            "--allow-miss does it as it is"
        )


def out_of_reach(promise: float, tried: Sequence[Tried]) -> str | None:
    """What there is to say of direct light that misses the tolerance, by a lower bound; None where it may keep it."""
    best = min((one.error for one in tried), key=lambda error: error.least, default=None)
    if best is None or best.least <= promise:
        return None
    return f"direct light alone errs by {best.share:.2%} ({best.where}), more than the tolerance of {promise:.2%}"


def _sharper(config: Config, scene: Scene, resolution: int, finer_helps: bool) -> str:
    """The option that brings the error of direct light down."""
    if config.receivers == "vertices":
        return f"--receivers pixels:{next(iter(scene.cameras), 'CAMERA')}, or a finer mesh"
    if resolution < RESOLUTIONS[-1] and finer_helps:
        return f"--light-resolution {2 * resolution}"
    grid = config.grid + 1
    finer = f"--pixel-grid {grid}" if grid <= MOST_PIXEL_GRID else "a larger picture"
    return finer + (f" or --light-resolution {2 * resolution}" if finer_helps else "")


def keep_promise_moving(config: Config, promise: float, scene: Scene, source: Geometry, writer: formats.Writer) -> None:
    """`keep_promise` where objects may be moved."""
    found = check_moved(config, promise, scene, source, writer)
    _keep(writer, found, promise)
    if found.share <= promise or config.allow_miss:
        return
    order = 1 + int(writer.attrs["fields"]["settings"]["order"])
    raise NumericalError(
        f"{config.output}: the error is {found.share:.2%} ({found.where}), more than the tolerance of {promise:.2%}. "
        f"What would help: --field-order {order}, as which shadows of what moves are sharp, or a finer mesh. The work "
        f"is kept in {writer.partial_path.name}; the same command with --allow-miss finishes it as it is"
    )


def _keep(writer: formats.Writer, found: pilot.Share, promise: float) -> None:
    """The error that was found, into the store."""
    measured: dict[str, Any] = {"share": found.share, "where": found.where}
    if math.isfinite(found.bound):  # else the two runs do not tell
        measured["bound"] = found.bound
    writer.set_attrs({"measured_error": {**measured, "tolerance": promise}})


def keep_promise(
    prepared: Prepared,
    receivers: Receivers | PixelReceivers,
    buried: NDArray[np.bool_] | None,
    writer: formats.Writer,
) -> Decided | None:
    """Measures the error of what was made and keeps it with it. None where that will do; else with what to try again;
    raises NumericalError where nothing is left to try.

    Tried again is with large faces cut, if they were not, and then with settings that will do if direct light errs in
    the same proportion to the trial's.
    """
    config, promise, source = prepared.config, prepared.promise, prepared.source
    assert promise is not None
    lighting = LightingStore(cast("formats.Store", Draft(writer)), config.workers)
    judge = Judge(prepared.scene, source, Tracer(source.positions, source.faces))
    views = check_views(prepared.scene, source, camera_of(config))
    strips = _strips(prepared.scene, prepared.geometry, receivers, buried, views)
    skies = check_skies()
    bounces = lighting.bounces
    edit = edit_of(prepared.scene.materials, set(prepared.scene.materials))
    found = judge.error(lighting, strips, skies, bounces, bounces + MORE, edit, promise)
    _keep(writer, found, promise)
    if found.share <= promise:
        return None
    if prepared.decided.faces == "whole":
        return Decided("cut")
    if config.allow_miss:
        return None
    direct = judge.error(lighting, strips, skies, 0, 0, None, DIRECT * promise)
    if direct.share <= DIRECT * promise:
        knob = f"--bounces {bounces + 1}, a finer --bounce-resolution, or a finer mesh to bounce light off"
    else:
        tried = prepared.trial_share
        care = 0.0 if tried is None else direct.share / max(tried, LEAST * promise)
        if care > AGAIN * prepared.decided.care:
            return replace(prepared.decided, care=care)
        knob = _sharper(config, prepared.scene, prepared.resolution, prepared.finer_helps)
    raise NumericalError(
        f"{config.output}: the error is {found.share:.2%} ({found.where}; of direct light {direct.share:.2%}), more "
        f"than the tolerance of {promise:.2%}. What would help: {knob}. The work is kept in "
        f"{writer.partial_path.name}; the same command with --allow-miss finishes it as it is"
    )

"""What the check at the end of `precompute --tolerance` will take, predicted by a dry run.

Path tracing is predicted from a few rows of one of the check's pictures. Light is computed in a store of which no more
than some receivers were traced, before and after that: what it takes without any is there for every store, the rest
goes with the receivers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

import relight_formats as formats
from relightcli.adapters.rays import Tracer
from relightcli.core.shade.gather import Gather
from relightcli.run.accounting import Meter
from relightcli.scene.model import Geometry, Scene
from relightcli.stages.lighting import LightingStore
from relightcli.stages.measured_error import (
    MORE,
    SAMPLES,
    STRIP,
    Draft,
    Judge,
    Sky,
    Strips,
    check_skies,
    check_views,
    rows_of,
)
from relightcli.stages.precompute_config import Config
from relightcli.stages.promise import Tried, camera_of

Costs = dict[str, float]
KEYS = ("seconds", "cpu_seconds")
MANY = 8  # times the least paths are traced, to see what passes take beside their paths


@dataclass(frozen=True)
class LightCosts:
    """seconds and cpu_seconds of the light of a picture: reflected once; after that, and what the first picture takes
    more of it."""

    direct: Costs
    bounced: Costs
    once: Costs

    def grown(self, none: LightCosts, times: float) -> LightCosts:
        """Of so many times the receivers, where `none` is what it takes without any."""
        return LightCosts(
            *(
                {key: fixed[key] + times * max(0.0, found[key] - fixed[key]) for key in KEYS}
                for found, fixed in zip(
                    (self.direct, self.bounced, self.once), (none.direct, none.bounced, none.once), strict=True
                )
            )
        )


class _Begun(LightingStore):
    """A store of which no more than some runs of receivers were traced. Where bits are read part by part no others are
    visited: what the many others take, over and over, would hide what these do."""

    def __init__(self, writer: formats.Writer, threads: int, runs: Sequence[slice]) -> None:
        super().__init__(cast("formats.Store", Draft(writer)), threads)
        self.runs = runs
        self.kept = int(self.kept * sum(run.stop - run.start for run in runs) / max(1, len(self)))

    def blocks(
        self, first: int = 0, last: int | None = None, needed: NDArray[np.bool_] | None = None
    ) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        if self._bits is not None:
            yield from super().blocks(first, last, needed)
            return
        for run in self.runs:
            start, stop = max(run.start, first), min(run.stop, len(self) if last is None else last)
            if start < stop:
                yield from super().blocks(start, stop, needed)

    def _gathers(self, first: int, last: int, step: int) -> Iterator[tuple[int, Gather]]:
        cells, ints, floats = self.store.layouts["bounce/hit"].shape[2], np.zeros(0, np.int32), np.zeros(0, np.float32)
        at = first

        def unseen(stop: int) -> tuple[int, Gather]:
            start = np.zeros(stop - at + 1, np.int64)
            return at, Gather(cells, start, ints, ints.astype(np.int16), floats, floats)

        for start, part in super()._gathers(first, last, step):
            if start > at:
                yield unseen(start)
            yield start, part
            at = start + len(part.start) - 1
        if at < last:
            yield unseen(last)


def measure_light(
    writer: formats.Writer, config: Config, scene: Scene, source: Geometry, bounces: int, runs: Sequence[slice] = ()
) -> LightCosts:
    """Times the light of a picture with what the store has by now, the bits of some runs of receivers."""
    sky = next(reversed(check_skies().values()))
    eye = np.array(check_views(scene, source, camera_of(config))[0].eye)
    _light(_Begun(writer, config.workers, runs), scene, sky, eye, bounces)  # kernels are loaded
    lighting = _Begun(writer, config.workers, runs)
    first, direct, whole = (_light(lighting, scene, sky, eye, number) for number in (bounces, 0, bounces))
    return LightCosts(
        direct,
        {key: max(0.0, whole[key] - direct[key]) for key in KEYS},
        {key: max(0.0, first[key] - whole[key]) for key in KEYS},
    )


def _light(lighting: LightingStore, scene: Scene, sky: Sky, eye: np.ndarray, bounces: int) -> Costs:
    d = eye - lighting.position
    view = (d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)).astype(np.float32)
    meter = Meter()
    lighting.exit_radiance(sky, 0.0, scene.materials, view, None, None, bounces)
    return meter.read()


def _trace(judge: Judge, strips: Strips, sky: Sky, bounces: int, times: int) -> Costs:
    meter = Meter()
    judge.trace(strips, sky, judge.scene.materials, bounces + MORE, 0, samples=times * SAMPLES)
    return meter.read()


def predict_check(
    only: str | None, scene: Scene, source: Geometry, bounces: int, tried: Sequence[Tried], light: LightCosts | None
) -> Costs:
    """seconds and cpu_seconds that the check will take: to trace, as often as it took for what was tried; for light
    reflected once, what that took there, if anything was tried; for the rest as `light` has it. only: the camera of a
    store of pixels."""
    judge = Judge(scene, source, Tracer(source.positions, source.faces))
    cameras, skies = check_views(scene, source, only), check_skies()
    middle = cameras[0].size[1] // 2
    rows = (max(0, middle - STRIP // 2), middle + max(1, STRIP // 2))
    strips, sky = Strips(cameras[0], [rows], []), next(iter(skies.values()))
    few, many = (_trace(judge, strips, sky, bounces, number) for number in (1, MANY))
    pixels = sum(sum(b - a for a, b in rows_of(c)) * c.size[0] for c in cameras)
    parts = 2 * len(skies) * pixels / ((rows[1] - rows[0]) * cameras[0].size[0])
    times = tried[-1].times if tried else 1.0
    pictures = len(skies) * len(cameras)
    out = {}
    for key in KEYS:
        each = max(0.0, many[key] - few[key]) / (MANY - 1)
        once = max(0.0, few[key] - each)
        out[key] = parts * (times * each + (1.0 + math.log2(times)) * once)
    for key in KEYS:
        if tried:
            out[key] += pictures * tried[-1].lit[key]
        if light is not None:
            direct = 0.0 if tried else light.direct[key]
            out[key] += pictures * (direct + light.bounced[key]) + light.once[key]
    return out

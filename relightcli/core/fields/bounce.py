"""The bouncing step: the light at every object's proxies, reflections between the objects included. [Pan 2007, 5]

    L^(b+1) = D + R L^(b),   L^(0) = 0

D what reaches the proxies from the sky and the lights, R what the objects reflect to each other; all proxies are
updated from the iterate before. The last iterate is the result: it holds the sum of all reflections so far. (The
paper's text adds the iterates up, its pseudocode adds the sources in every one: both together would count them again.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from relightcli.core.fields.chain import light_at, open_rows, put_reflections
from relightcli.core.fields.entities import Entity, look_up
from relightcli.errors import NumericalError

CONVERGED = 1e-3
MOST_BOUNCES = 64


@dataclass(frozen=True)
class Settled:
    """lights, one (m, 3, N) float32 for every entity, in the world's frame; bounces done; change, the last one relative
    to the light; samples_read, and how often: 1 - samples_read / reads is the hit rate of the cache of samples."""

    lights: list[NDArray[np.float32]]
    bounces: int
    change: float
    samples_read: int
    reads: int


def settle(
    entities: list[Entity],
    sky: NDArray[np.floating],
    bounces: int | None = None,
    windowed: float = 0.0,
    start: list[NDArray[np.float32]] | None = None,
    threads: int = 1,
) -> Settled:
    """The light at all proxies under a sky (3, N).

    bounces: iterate that many times, so that light is reflected up to `bounces` times on its way to a proxy; None:
    until it changes by less than CONVERGED. start: lights to begin with, those of the frame before, say; no matter to
    the limit. Raises NumericalError if it does not converge.
    """
    sky = np.asarray(sky, np.float32)
    n = sky.shape[1]
    order = round(n**0.5)
    places = [entity.proxies for entity in entities]
    cuts = np.cumsum([len(p) for p in places])[:-1]
    skip = np.repeat(np.arange(len(entities), dtype=np.int32), [len(p) for p in places])
    lookup = look_up(entities, np.concatenate([np.zeros((0, 3)), *places]), skip, threads)
    rows = open_rows(entities, lookup, order, windowed, threads)
    lights = [np.zeros((len(p), 3, n), np.float32) for p in places] if start is None else start
    done, change = 0, np.inf
    while True:
        if done or start is not None:
            put_reflections(rows, entities, lookup, lights, windowed, threads)
        now = light_at(lookup, rows, sky, threads)
        before = np.concatenate([np.zeros((0, 3, n), np.float32), *lights])
        largest = float(np.abs(now).max(initial=0.0))
        change = float(np.abs(now - before).max(initial=0.0)) / largest if largest > 0.0 else 0.0
        lights = np.split(now, cuts)
        if not np.isfinite(change) or (bounces is None and done > MOST_BOUNCES):
            raise NumericalError(
                f"light between moving objects: after {done} reflections it still changes by {change:.3g} of itself"
            )
        if done == bounces or (bounces is None and change < CONVERGED):
            break
        done += 1
    reads = int((lookup.weight > 0.0).sum())
    return Settled(lights, done, change, len(lookup.sample), reads)

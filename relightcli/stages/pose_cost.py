"""What fit-pose will take, predicted by its dry run from some vertices and pictures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import relight_formats as formats
from relightcli.plan import pilot
from relightcli.stages.measured_error import check_skies
from relightcli.stages.part_cost import Costs, copying, grown, scratch, stored_bytes
from relightcli.stages.pose_fits import DIMS, LEFT_OUT, SIZES, Config, fit_object, put_arrays
from relightcli.stages.promise_pose import CHECK, TRIAL, Fitted, Place, PoseJudge, places_between

FITTED = (1000, 1500)  # vertices that are fitted: from a thousand on, what a fit takes goes with their number


def predict_fit(config: Config, store: formats.Store, tolerance: float | None) -> Costs:
    """What the stage will take: with a tolerance, all models tried; models by those of some vertices."""
    poses: dict[str, Any] = store.attrs["poses"]
    sizes: tuple[tuple[str, int] | None, ...] = (None,) if tolerance is None else SIZES
    out, arrays, told = Costs(), {}, {}
    with scratch("pose", store.settings, store.attrs) as writer:
        left_out = tuple(f"pose/{k}/{name}" for k in poses for name in LEFT_OUT)
        out.add(copying(store, [name for name in store.names() if name not in left_out], writer))
        for k, about in poses.items():
            rows = store.layouts[f"pose/{k}/visibility"].shape[1]
            for number, size in enumerate(sizes):
                group = f"try-{number}/{k}"

                def part(
                    count: int, k: str = k, about: Any = about, size: Any = size, group: str = group, rows: int = rows
                ) -> Costs:
                    cost = Costs()
                    with cost.timed():
                        fit = fit_object(config, store, k, about, size, count)
                        put_arrays(writer, group, fit.arrays)
                    cost.bytes = stored_bytes(writer, group)
                    writer.drop(group)
                    told[k] = fit.about
                    for name, array in fit.arrays.items():
                        like = np.resize(array, (rows, *array.shape[1:])) if DIMS[name][0] == "vertex_side" else array
                        arrays[f"pose/{k}/model/{name}"] = like
                    return cost

                found = grown(part, (min(rows, FITTED[0]), min(rows, FITTED[1])), rows)
                found.bytes *= number == 0  # one of them is kept
                out.add(found)
    if tolerance is not None:
        out.add(_predict_pictures(config, Fitted(store, arrays, told), places_between(store, CHECK), len(sizes)))
    return out


def _predict_pictures(config: Config, store: Fitted, places: list[Place], tries: int) -> Costs:
    """What the pictures take that models are chosen by, and those of the check."""
    judge = PoseJudge(config.workers)
    skies = list(check_skies().items())
    costs = [Costs(), Costs(), Costs()]
    for cost, some in zip(costs, (skies[:1], skies[:1], skies[:2]), strict=True):
        judge.known.clear()
        with cost.timed():
            judge.error(store, places[:1], None, dict(some), math.inf)
    first, one, two = costs  # of all views; the first loads kernels
    # Of a sky more; on a machine that others use it may come out below nothing.
    sky = Costs(max(0.0, two.seconds - one.seconds), max(0.0, two.cpu_seconds - one.cpu_seconds))
    out = Costs()
    out.add(first)
    pictures = len(skies) * len(CHECK) + tries * len(pilot.skies(False)) * len(TRIAL)
    out.add(one, float(len(CHECK) + tries * len(TRIAL)))
    out.add(sky, float(pictures - len(CHECK) - tries * len(TRIAL)))
    return out

"""From a sweep's records and pictures to its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from relightcli.stages.tradeoff_knobs import Point
from relightcli.stages.tradeoff_measure import (
    BEAUTY,
    VARIANCE,
    Truth,
    apart_noise,
    measure,
    read_layers,
    read_truth,
    together,
    traced_error,
)
from relightcli.stages.tradeoff_page import Shown
from relightcli.stages.tradeoff_result import Measured, Result, Traced
from relightcli.stages.tradeoff_runs import Runs, Step, View
from relightcli.stages.tradeoff_setup import Config


def collect(
    config: Config,
    runs: Runs,
    points: Sequence[Point],
    chains: Mapping[str, Sequence[Step]],
    views: Sequence[View],
    traced: Sequence[int],
    impossible: Mapping[str, str],
    tolerance: float,
    machine: str,
) -> tuple[Result, tuple[Shown, list[Shown]]]:
    """Measures what has not been measured yet. Returns the result, and the pictures of the first view for the page: the
    reference, and those of the points on the fronts."""
    truths = [_truth(config, runs, view) for view in views]
    measured = [_measured(config, runs, point, chains[point.label], views, truths) for point in points]
    result = Result(
        scene=str(config.scene),
        views=tuple(view.name for view in views),
        spp=config.spp,
        bounces=config.bounces,
        tolerance=tolerance,
        machine=machine,
        workers=config.workers,
        points=tuple(measured),
        traced=tuple(_traced(config, runs, spp, views, truths) for spp in traced),
        impossible=dict(impossible),
        looks={view.name: _look(config, view) for view in views},
    )
    noise = {}
    for i, j in result.pairs():
        pictures_of = [[runs.picture(chains[points[k].label][-1], view) for view in views] for k in (i, j)]
        noise[i, j] = apart_noise(list(zip(*pictures_of, strict=True)), truths)
    result = replace(result, pair_noise=noise)
    a, b = truths[0].a[BEAUTY], truths[0].b[BEAUTY]
    reference = Shown(0.5 * (a + b), f"Path tracing, {config.spp} samples a pixel, {views[0].name}")
    pictures = []
    for k in result.on_front():
        path = runs.picture(chains[points[k].label][-1], views[0])
        caption = f"#{k + 1} {measured[k].label}: error {measured[k].error.error:.2%} over all views; {views[0].name}"
        pictures.append(Shown(read_layers(path)[BEAUTY], caption))
    return result, (reference, pictures)


def _truth(config: Config, runs: Runs, view: View) -> Truth:
    a, b = (runs.reference(view, config.spp // 2, config.seed + k, config.bounces)[0] for k in (0, 1))
    return read_truth(view.name, a, b)


def _look(config: Config, view: View) -> list[list[str]]:
    """The commands of a picture from a store, and of one half of the truth."""
    seen = ["--env", view.environment, "--camera", view.camera, "--layers"]
    truth = ["--reference", "--spp", str(config.spp // 2), "--bounces", str(config.bounces)]
    return [
        ["relightcli", "relight", "transfer.zarr", "-o", "picture.exr", *seen],
        ["relightcli", "relight", str(config.scene), "-o", "truth.exr", *seen, *truth, "--seed", str(config.seed)],
    ]


def _measured(
    config: Config, runs: Runs, point: Point, steps: Sequence[Step], views: Sequence[View], truths: Sequence[Truth]
) -> Measured:
    errors = []
    for view, truth in zip(views, truths, strict=True):
        path = runs.picture(steps[-1], view)
        kept = path.with_name(f"{path.stem}-against-{config.spp}-{config.seed}-{config.bounces}.json")
        errors.append(measure(path, truth, kept))
    records = [runs.record(step.name) for step in steps]
    frames = runs.record(runs.frames(steps[-1], views[0], 1))
    further = [min(r["answer"]["frame_seconds"][1:]) for r in frames]
    first = [r["seconds"] - sum(r["answer"]["frame_seconds"][1:]) for r in frames]
    seconds = [[r["seconds"] for r in record] for record in records]
    return Measured(
        label=point.label,
        settings=dict(point.settings),
        commands=tuple(tuple(step.command(str(config.scene))) for step in steps),
        error=together([view.name for view in views], errors),
        seconds=sum(min(s) for s in seconds),
        seconds_spread=sum(max(s) - min(s) for s in seconds),
        cpu_seconds=sum(min(r["cpu_seconds"] for r in record) for record in records),
        picture_seconds=min(first),
        frame_seconds=min(further),
        frame_spread=max(further) - min(further),
        bytes=int(records[-1][0]["answer"]["bytes"]),
        peak_bytes=max(r["peak_bytes"] for record in records for r in record),
        repeats=min(len(record) for record in records),
    )


def _traced(config: Config, runs: Runs, spp: int, views: Sequence[View], truths: Sequence[Truth]) -> Traced:
    found = [runs.reference(view, spp, config.seed, config.bounces) for view in views]
    real = int(found[0][1]["answer"]["spp"])
    seconds = sum(record["seconds"] for _, record in found) / len(found)
    return Traced(real, seconds, traced_error([read_layers(path)[VARIANCE] for path, _ in found], truths))

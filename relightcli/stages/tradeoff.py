"""Stage tradeoff: a scene in, a report out. What accuracy costs in time and bytes, measured point by point."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from relight_formats.lock import Lock
from relightcli.adapters.files import need_output
from relightcli.errors import InputError, NumericalError, StoreError
from relightcli.scene.parse import load_scene
from relightcli.stages.outputs import resolve_camera
from relightcli.stages.tradeoff_knobs import KNOBS, Point, default_knobs, expand, parse_knobs
from relightcli.stages.tradeoff_runs import Runs, Step, View
from relightcli.stages.tradeoff_setup import LEAST_SPP, Config, command_of, make_views, open_folder
from relightcli.stages.tradeoff_tables import table_text

__all__ = ["Config", "tradeoff"]


def tradeoff(config: Config) -> dict[str, Any]:
    """Runs the stage; returns the result as plain data. Raises the errors of `relightcli.errors` and OSError."""
    _check(config)
    need_output(config.output)
    scene = load_scene(config.scene, allow_outside=config.allow_outside)
    cameras = [resolve_camera(name, scene.cameras).name for name in dict.fromkeys(config.cameras or (None,))]
    camera = cameras[0] if len(cameras) == 1 else None
    knobs = parse_knobs(config.knobs) if config.knobs else default_knobs(config.bounces)
    points = expand(knobs, config.bounces, camera)
    _check_points(points, cameras, config.bounces)
    if config.dry_run:
        return _dry_run(config, points, camera)
    lock = Lock(config.output)  # held until the report is written
    try:
        machine = open_folder(config, scene)
        runs = Runs(config.output, config.scene, config.workers, config.allow_outside)
        views = make_views(config, scene, cameras)
        chains = {point.label: steps_of(point, views[0].camera) for point in points}
        traced = sorted({config.spp // 16, config.spp // 4, config.spp // 2})
        impossible = _run_all(config, runs, points, chains, views, traced)
        made = [point for point in points if point.label not in impossible]
        from relightcli.stages.tradeoff_collect import collect  # large; the programs that were timed are larger now
        from relightcli.stages.tradeoff_page import write_report

        limits = (scene.tolerance if config.tolerance is None else config.tolerance, machine)
        result, shown = collect(config, runs, made, chains, views, traced, impossible, *limits)
        files = write_report(config.output, result, *shown, command_of(config))
    finally:
        lock.release()
    return {
        "report": str(config.output),
        "status": "written" if runs.count else "up to date",
        "commands_run": runs.count,
        "files": files,
        "table": table_text(result),
        **result.to_json(),
    }


def _check(config: Config) -> None:
    if config.spp < LEAST_SPP or config.spp % 2:
        raise InputError(f"--spp: expected an even number of at least {LEAST_SPP}; found {config.spp}")
    if config.tolerance is not None and not 0.0 < config.tolerance < 1.0:
        raise InputError(f"--tolerance: expected more than 0 and less than 1; found {config.tolerance}")


def _check_points(points: list[Point], cameras: list[str], bounces: int) -> None:
    """Raises InputError for points that the truth or the views of the sweep cannot judge."""
    for point in points:
        settings = dict(point.settings)
        if int(settings["bounces"]) > bounces:
            raise InputError(
                f"--knob bounces={settings['bounces']}: more than the truth has; expected at most --bounces {bounces}"
            )
        if settings.get("store") == "lights" and len(cameras) > 1:
            raise InputError("--knob store=lights: keeps specular lobes for one view; expected one --camera")
        receivers = settings.get("receivers", "vertices")
        if receivers != "vertices" and cameras != [receivers.removeprefix("pixels:")]:
            raise InputError(
                f"--knob receivers={receivers}: such a store shows no other camera, and the sweep is judged by "
                f"{', '.join(cameras)}; give --camera {receivers.removeprefix('pixels:')} and no other"
            )


def steps_of(point: Point, camera: str) -> list[Step]:
    """The commands of a point, each from the store of the one before."""
    steps: list[Step] = []
    for stage in point.stages:
        words = point.words(stage)
        settings = dict(point.settings)
        if stage == "cluster" and settings.get("store") == "lights" and "pixels" not in settings.get("receivers", ""):
            words = (*words, "--camera", camera)  # for specular lobes, which are kept for one view
        steps.append(Step(stage, words, steps[-1] if steps else None))
    return steps


def _dry_run(config: Config, points: list[Point], camera: str | None) -> dict[str, Any]:
    """The points, and the seconds that `precompute` predicts for the simulations of each."""
    runs = Runs(config.output, config.scene, config.workers, config.allow_outside)
    told: dict[str, dict[str, Any]] = {}
    listed = []
    for point in points:
        steps = steps_of(point, camera or "")
        first = steps[0]
        if first.name not in told:
            told[first.name] = runs.predict(first)["predicted"]
        commands = [" ".join(step.command(str(config.scene))) for step in steps]
        listed.append({"label": point.label, "commands": commands, "predicted": told[first.name]})
    return {
        "dry_run": True,
        "report": str(config.output),
        "points": listed,
        "repeats": config.repeats,
        "predicted_seconds": config.repeats * sum(t["seconds"] for t in told.values()),
    }


class _Progress:
    """A bar on stderr; nothing where that is no terminal."""

    def __init__(self, total: int, quiet: bool) -> None:
        self._bar: Any = None
        if not quiet and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, unit="step", file=sys.stderr)

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()

    def say(self, what: str) -> None:
        if self._bar is not None:
            self._bar.set_description(what)

    def step(self) -> None:
        if self._bar is not None:
            self._bar.update(1)


def _run_all(
    config: Config,
    runs: Runs,
    points: Sequence[Point],
    chains: Mapping[str, Sequence[Step]],
    views: Sequence[View],
    traced: Sequence[int],
) -> dict[str, str]:
    """Runs whatever has no record yet; returns the points that could not be made, with the reason.

    Repeats go in rounds, so that a machine that is busy for a while slows all points alike.
    """
    impossible: dict[str, str] = {}
    total = len(points) * (config.repeats + 1) + len(views) * (len(traced) + 1)
    with _Progress(total, config.quiet) as progress:
        if not any(runs.record(step.name) for steps in chains.values() for step in steps):
            progress.say("warming up")
            runs.warm(_small(points[0], views[0].camera), views[0])
        for times in range(1, config.repeats + 1):
            for point in points:
                progress.say(f"{point.label}, run {times}")
                if point.label not in impossible:
                    try:
                        _make(runs, chains[point.label], views[0], times)
                    except (InputError, StoreError, NumericalError) as error:
                        # A point of the built-in sweep that a scene does not allow is left out and named.
                        if config.knobs or point is points[0]:
                            raise type(error)(f"{point.label}: {error}; what is finished is kept") from None
                        impossible[point.label] = str(error)
                progress.step()
        for point in points:
            progress.say(f"{point.label}, pictures")
            if point.label not in impossible:
                for view in views:
                    runs.picture(chains[point.label][-1], view)
            progress.step()
        for view in views:
            progress.say(f"path tracing, {view.name}")
            for spp in traced:
                runs.reference(view, spp, config.seed, config.bounces)
                progress.step()
            runs.reference(view, config.spp // 2, config.seed + 1, config.bounces)
            progress.step()
        runs.remove_stores()
    return impossible


def _make(runs: Runs, steps: Sequence[Step], view: View, times: int) -> None:
    for step in steps:
        runs.make(step, times)
    runs.frames(steps[-1], view, times)


def _small(point: Point, camera: str) -> Step:
    """The first command of a point with few texels: what it compiles is the same."""
    few = {"light-resolution": "16", "refine": "4", "bounce-resolution": "8", "coefficients": "16"}
    given = dict(point.settings)
    settings = {**given, **{k: v for k, v in few.items() if k in given}, "light-resolution": "16"}
    return steps_of(Point("", tuple((k, settings[k]) for k in KNOBS if k in settings)), camera)[0]

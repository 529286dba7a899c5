"""relightcli tradeoff."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="tradeoff")
@click.argument("scene", type=options.PATH)
@options.output("Folder of the report, e.g. report/. What is in it already is not run again.")
@click.option(
    "--knob",
    "knobs",
    multiple=True,
    metavar="NAME=V1,V2,...",
    help="A setting and its values, repeatable: the first is that of all points, each other one makes a point. "
    "Default: a small sweep.",
)
@click.option(
    "--env", "envs", multiple=True, help="A map, or an environment of the scene; repeatable. Default: all the scene's."
)
@click.option("--camera", "cameras", multiple=True, help="A camera of the scene; repeatable. Default: its first.")
@click.option(
    "--bounces", default=2, show_default=True, type=click.IntRange(0, 64), help="Interreflections of the truth."
)
@click.option(
    "--spp", default=64, show_default=True, type=click.IntRange(2, 1 << 20), help="Samples a pixel of the truth."
)
@click.option(
    "--repeats", default=2, show_default=True, type=click.IntRange(1, 100), help="Times that each point is run."
)
@click.option(
    "--tolerance", default=None, type=float, help="Error for which the cheapest point is named. Default: the scene's."
)
@click.option("--seed", default=0, type=options.SEED, show_default=True, help="Seed of the path tracing.")
@click.option("--allow-outside", is_flag=True, help="Let the scene file use files outside its folder.")
@click.option("--dry-run", is_flag=True, help="Print the points and their predicted seconds; do nothing.")
@options.workers
@options.overwrite
@options.report
def command(
    scene: Path, output: Path, workers: int | None, verbose: bool, quiet: bool, as_json: bool, **settings: Any
) -> None:
    """Measure what accuracy costs: settings of SCENE against path tracing, in error, seconds and bytes."""
    from relightcli.stages.tradeoff import Config, tradeoff

    config = Config(
        scene=scene,
        output=output,
        workers=workers or options.available_cores(),
        quiet=quiet or as_json,
        **settings,
    )
    result = tradeoff(config)
    table = result.pop("table", "")
    options.tell(result, _text(result, table), as_json, quiet)


def _text(result: dict[str, Any], table: str) -> str:
    if result.get("dry_run"):
        lines = [
            f"{p['predicted']['seconds']:8.1f} s  {p['label']}: {'; '.join(p['commands'])}" for p in result["points"]
        ]
        total = f"{result['predicted_seconds']:.0f} s predicted for the simulations, {result['repeats']} times each"
        return "\n".join([*lines, f"{total}; stages after precompute, pictures and path tracing come on top"])
    what = "is up to date" if result["status"] == "up to date" else f"{result['commands_run']} commands run"
    return "\n".join(
        [table, *result["remarks"], *result["undecided"], f"{result['report']}: {what}; the page is index.html in it"]
    )

"""relightcli cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="cluster")
@click.argument("store", type=options.PATH)
@options.output("Clusters store to make, e.g. clusters.zarr.")
@click.option(
    "--clusters", default=None, type=click.IntRange(1, 1 << 20), help="Groups of receivers. Default: one per 1000."
)
@click.option(
    "--tolerance",
    default=0.01,
    show_default=True,
    type=float,
    help="Relative RMS of interreflections that the basis for light may leave out.",
)
@click.option(
    "--functions",
    default=4,
    show_default=True,
    type=click.IntRange(1, 16),
    help="Basis functions for the specular lobe of an adjustable material, as light bounces off it.",
)
@click.option("--seed", default=0, type=options.SEED, show_default=True, help="Seed of samples and first centres.")
@click.option("--dry-run", is_flag=True, help="Say what would be made; do nothing.")
@options.workers
@options.overwrite
@options.report
def command(
    store: Path, output: Path, workers: int | None, verbose: bool, quiet: bool, as_json: bool, **settings: Any
) -> None:
    """Group the receivers of the transfer store STORE, and find a basis for their light."""
    from relightcli.stages.cluster import Config, cluster

    config = Config(
        store=store, output=output, workers=workers or options.available_cores(), quiet=quiet or as_json, **settings
    )
    result = cluster(config)
    options.tell(result, _text(result), as_json, quiet)


def _text(result: dict[str, Any]) -> str:
    if result.get("dry_run"):
        return f"{result['receivers']} receivers in {result['clusters']} clusters"
    if result["status"] == "up to date":
        return f"{result['store']} is up to date"
    return (
        f"{result['store']}: {result['receivers']} receivers in {result['clusters']} clusters, light of rank "
        f"{result['light_rank']} (leaves {result['light_error']:.1%}), {options.bytes_text(result['bytes'])}, "
        f"{result['seconds']:.1f} s"
    )

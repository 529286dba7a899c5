"""relightcli factorize."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


def _ranks(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[int, int, int] | None:
    if value is None:
        return None
    try:
        h, o, i = (int(part) for part in value.split(","))
    except ValueError:
        h = o = i = 0
    if min(h, o, i) < 1:
        raise click.BadParameter(f"expected three whole numbers from 1 on, as in 8,16,8; found {value!r}")
    return h, o, i


@click.command(name="factorize")
@click.argument("store", type=options.store_path)
@options.output("Asset to make, e.g. asset.zarr.")
@click.option(
    "--eigenvectors",
    default=None,
    type=click.IntRange(1, 4096),
    help="Rank along the receivers of a cluster. Default: 32, or what the tolerance takes.",
)
@click.option(
    "--light-rank",
    default=None,
    type=click.IntRange(1, 4096),
    help="Rank along light, per cluster. Default: 64, or what the tolerance takes.",
)
@click.option(
    "--second-order",
    default=0,
    show_default=True,
    type=click.IntRange(0, 4),
    help="Bands of spherical harmonics for the second bounce; 0 is a uniform value.",
)
@click.option(
    "--coefficients",
    default=None,
    type=click.IntRange(1, 1 << 16),
    help="Haar coefficients of direct light kept per receiver and light factor. Default: 96, or what the tolerance "
    "takes.",
)
@click.option(
    "--tolerance",
    default=None,
    type=float,
    help="Relative RMS error of radiance to keep, all stages together. Default: that of the store, if it has one.",
)
@click.option("--allow-miss", is_flag=True, help="Keep the asset where its error is larger than the tolerance.")
@click.option(
    "--brdf-ranks",
    default=None,
    callback=_ranks,
    metavar="H,O,I",
    help="Ranks of the tensors of BRDFs: reflectance, view, light. Default: 8,16,8 for cook-torrance, 6,16,8 for "
    "blinn-phong.",
)
@click.option("--dry-run", is_flag=True, help="Say what would be made and what it should cost; do nothing.")
@options.no_seed
@options.workers
@options.scheduler
@options.overwrite
@options.report
def command(
    store: Path,
    output: Path,
    workers: int | None,
    scheduler: str | None,
    verbose: bool,
    quiet: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Compress the transfer tensors of the clusters store STORE into an asset that pictures are made from."""
    from relightcli.stages.factorize import Config, factorize

    config = Config(
        store=store, output=output, workers=workers or options.available_cores(), quiet=quiet or as_json, **settings
    )
    result = factorize(config)
    options.note_no_blocks(result, scheduler)
    options.tell(result, _text(result), as_json, quiet)


def _text(result: dict[str, Any]) -> str:
    lines = [f"note: {note}" for note in result["notes"]]
    if result.get("dry_run"):
        lines.append(
            f"{result['receivers']} receivers in {result['clusters']} clusters; {options.predicted_text(result)}"
        )
    elif result["status"] == "up to date":
        lines.append(f"{result['store']} is up to date")
    else:
        lost = ", ".join(f"{name} leaves {error['total']:.1%}" for name, error in result["errors"].items())
        lines.append(
            f"{result['store']}: {result['receivers']} receivers, {lost}, {options.bytes_text(result['bytes'])}, "
            f"{result['seconds']:.1f} s"
        )
    return "\n".join(lines)

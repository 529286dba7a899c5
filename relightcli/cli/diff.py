"""`relightcli diff A B`: measure a picture, a sequence or a store against a reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from relightcli.cli import options

if TYPE_CHECKING:
    from relightcli.stages.diff_result import DiffResult


@click.command("diff")
@click.argument("a", type=options.store_path)
@click.argument("b", type=options.store_path)
@click.option(
    "--metric",
    "metrics",
    multiple=True,
    type=click.Choice(["rmse", "relrmse", "psnr", "flip"]),
    help="What to measure; several allowed, the first leads. [default: relrmse]",
)
@click.option(
    "--fail",
    multiple=True,
    metavar="X",
    help="Fail above X (psnr: below X); METRIC=X for one of several, repeatable. [default: any difference fails]",
)
@click.option(
    "--fail-percent",
    type=click.FloatRange(0, 100),
    metavar="P",
    help="Fail only if more than P percent of the pixels are, each by itself, beyond the threshold.",
)
@click.option("--tolerance", type=click.FloatRange(0), metavar="X", help="The same as --fail relrmse=X.")
@click.option("--heatmap", type=options.PATH, help="Write the first metric per pixel as a picture.")
@click.option("--report", type=options.PATH, help="Write one self-contained HTML page.")
@click.option("--dry-run", is_flag=True, help="Name what would be compared; do nothing.")
@options.no_seed
@options.no_workers
@options.report
@click.pass_context
def command(
    context: click.Context,
    a: Path,
    b: Path,
    metrics: tuple[str, ...],
    fail: tuple[str, ...],
    fail_percent: float | None,
    tolerance: float | None,
    heatmap: Path | None,
    report: Path | None,
    dry_run: bool,
    as_json: bool,
    quiet: bool,
    verbose: bool,
) -> None:
    """Measure A, the test, against B, the reference.

    A and B are two pictures of any format, two folders of pictures or two names like out.####.exr, or two stores. The
    exit code is 0 within the thresholds and 1 beyond; NaN or infinity in a picture always fails. Pictures of different
    size or channels are an error, code 2.
    """
    from relightcli.stages.diff import diff, plan
    from relightcli.stages.diff_result import DiffSettings, parse_thresholds

    if tolerance is not None:
        metrics, fail = (*metrics, "relrmse"), (*fail, f"relrmse={tolerance!r}")
    # Asking twice is asking once.
    metrics = tuple(dict.fromkeys(metrics)) or ("relrmse",)
    settings = DiffSettings(metrics, parse_thresholds(fail, metrics), fail_percent, heatmap, report)
    if dry_run:
        planned = plan(a, b)
        text = [f"{name}: {options.bytes_text(size)}" for name, size in planned["items"].items()]
        options.tell(planned, "\n".join([f"would compare, of kind {planned['kind']}:", *text]), as_json, quiet)
        return
    result = diff(a, b, settings)
    if as_json or not quiet:
        click.echo(json.dumps(result.to_json()) if as_json else _text(result))
    context.exit(0 if result.passed else 1)


def _text(result: DiffResult) -> str:
    lines = list(result.notes)
    for item in result.comparisons:
        values = [f"{metric} {value:.5g}" for metric, value in item.values.items()]
        lines.append(f"{item.name}: " + (", ".join(values) or "not measured") + ("" if item.passed else "  FAILED"))
        lines += [f"  {reason}" for reason in item.reasons]
        for part, measured in item.parts.items():
            lines.append(f"  {part}: " + ", ".join(f"{metric} {value:.5g}" for metric, value in measured.items()))
        lines += [f"  note: {note}" for note in item.notes]
    failed = sum(not item.passed for item in result.comparisons)
    lines.append("passed" if result.passed else f"failed: {failed} of {len(result.comparisons)}")
    return "\n".join(lines)

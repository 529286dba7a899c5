"""relightcli fit-pose."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="fit-pose")
@click.argument("store", type=options.store_path)
@options.output("Pose store to make, e.g. pose.zarr.")
@click.option(
    "--model",
    type=click.Choice(["lobes", "sh", "reduced"]),
    default="lobes",
    show_default=True,
    help="What is linear in the pose: zonal lobes, harmonic coefficients, or those of few components.",
)
@click.option("--lobes", default=2, show_default=True, type=click.IntRange(1, 4), help="Lobes of a vertex.")
@click.option(
    "--axes",
    type=click.Choice(["log", "angles"]),
    default="log",
    show_default=True,
    help="Lobe axes as logarithms about their mean, or as the paper's polar angles.",
)
@click.option(
    "--weight",
    type=click.Choice(["none", "cosine"]),
    default="none",
    show_default=True,
    help="Model visibility, or visibility times the cosine, which lights lambert materials only.",
)
@click.option(
    "--ridge",
    default=None,
    type=float,
    help="Penalty on slopes, relative to the poses' largest spread. Default: what predicts held-out frames best.",
)
@click.option(
    "--components",
    default=20,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="Principal components of the poses, at most.",
)
@click.option(
    "--tolerance",
    default=None,
    type=float,
    help="Relative RMS error of radiance to keep in poses between the frames learnt from: the smallest model that does "
    "is taken, whatever --model and --lobes say. Default: that of a store made with one.",
)
@click.option("--allow-miss", is_flag=True, help="Keep the store where its error is larger than the tolerance.")
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
    """Learn from the transfer store STORE what skinned objects see of the sky in any pose."""
    from relightcli.stages.fit_pose import Config, fit_pose

    config = Config(
        store=store, output=output, workers=workers or options.available_cores(), quiet=quiet or as_json, **settings
    )
    result = fit_pose(config)
    options.note_no_blocks(result, scheduler)
    options.tell(result, _text(result), as_json, quiet)


def _text(result: dict[str, Any]) -> str:
    lines = [f"note: {note}" for note in result["notes"]]
    if result.get("dry_run"):
        lines += [
            f"{o['object']}: {o['frames']} frames of {o['vertices']} vertices, {o['coefficients']} coefficients each"
            for o in result["objects"]
        ]
        lines.append(options.predicted_text(result))
    elif result["status"] == "up to date":
        lines.append(f"{result['store']} is up to date")
    else:
        for o in result["objects"]:
            seen = "" if o["held_out"] is None else f", {o['held_out']['bands']:.1%} at held-out ones"
            lines.append(
                f"{o['object']}: {o['vertices']} vertices, {options.bytes_text(o['bytes'])}, visibility errs by "
                f"{o['training']['bands']:.1%} at training frames{seen}; {o['seconds']:.1f} s"
            )
        if "measured_error" in result:
            lines.append(f"pictures of poses between the training frames err by {result['measured_error']:.1%}")
        lines.append(f"{result['store']}: {options.bytes_text(result['bytes'])}, {result['seconds']:.1f} s")
    return "\n".join(lines)

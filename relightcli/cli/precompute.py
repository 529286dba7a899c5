"""relightcli precompute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="precompute")
@click.argument("scene", type=options.PATH)
@options.output("Transfer store to make, e.g. transfer.zarr.")
@click.option(
    "--effects",
    default="auto",
    show_default=True,
    help="auto, all, or names: direct,shadows,one-bounce,two-bounce,specular,fields,pose.",
)
@click.option(
    "--light-resolution",
    default=None,
    type=int,
    help="Texels along a face of the sky cube: 16 to 256. Default: 64, or what --tolerance takes.",
)
@click.option(
    "--refine", default=4, show_default=True, help="Visibility is probed every N texels and refined; 1 traces them all."
)
@click.option("--receivers", default="vertices", show_default=True, help="vertices, or pixels:CAMERA.")
@click.option(
    "--pixel-grid",
    default=None,
    type=int,
    help="Receivers along a pixel's side, for pixels:CAMERA. Default: 1, or what --tolerance takes.",
)
@click.option(
    "--subdivide/--no-subdivide", default=True, help="Cut faces that are too large to carry shadows. Default: cut."
)
@click.option(
    "--basis",
    default="visibility",
    show_default=True,
    help="visibility (exact), or for Lambert surfaces in addition haar, sh or dense transfer.",
)
@click.option("--coefficients", default=128, show_default=True, help="Haar coefficients kept per receiver, at most.")
@click.option(
    "--tolerance",
    default=None,
    type=float,
    help="Relative RMS error of radiance to keep: settings are chosen for it, and it is measured at the end. With "
    "--basis haar: of a receiver's transfer, that coefficients left out may cost.",
)
@click.option("--allow-miss", is_flag=True, help="Keep the store where its error is larger than --tolerance.")
@click.option("--sh-order", default=6, show_default=True, help="Bands of the spherical harmonics.")
@click.option(
    "--bounces",
    default=None,
    type=int,
    help="Interreflections. Default: what --effects names; auto: as many as the scene calls for.",
)
@click.option(
    "--bounce-resolution",
    default=None,
    type=int,
    help="Cells along a cube face through which light bounces: 8, 16 (default) or 32.",
)
@click.option(
    "--pose-frames",
    default="spread:200",
    show_default=True,
    help="Frames that poses of skinned objects are learnt from: all, every:N of each clip, or spread:N far apart.",
)
@click.option("--pose-order", default=4, show_default=True, help="Bands of what posed vertices see: 1 to 8.")
@click.option("--pose-directions", default=1024, show_default=True, help="Rays of a posed vertex in each frame.")
@click.option(
    "--pose-surroundings/--no-pose-surroundings",
    default=False,
    help="Let other objects block posed vertices, where the clips take them. Default: their own body alone.",
)
@click.option("--field-shells", default=16, show_default=True, help="Spheres around what moves on which fields lie.")
@click.option(
    "--field-resolution",
    default=None,
    type=int,
    help="Directions along a cube face on every sphere. Default: 16, and 32 for objects with a fixed specular lobe.",
)
@click.option("--field-proxies", default=8, show_default=True, help="Points of an object that take its light, at most.")
@click.option("--field-order", default=4, show_default=True, help="Bands of the spherical harmonics of fields.")
@click.option(
    "--field-spacing",
    type=click.Choice(["geometric", "paper", "adaptive"]),
    default="geometric",
    show_default=True,
    help="Spheres from 1.02 to 8 radii in equal ratios, from 0.1 to 8 in equal steps, or where the field bends.",
)
@click.option(
    "--field-tolerance",
    default=None,
    type=float,
    help="Relative error of the compressed transfer. Default: 0.01, and 0.02 for objects with a specular lobe.",
)
@click.option(
    "--field-library",
    default=None,
    type=options.PATH,
    metavar="DIR",
    help="Keep fields as stores of their own in this folder, and take from there what other scenes have made.",
)
@click.option("--seed", default=0, type=options.SEED, show_default=True, help="Seed of the random checks.")
@click.option("--allow-outside", is_flag=True, help="Let the scene file use files outside its folder.")
@click.option("--dry-run", is_flag=True, help="Print the plan and its predicted cost; do nothing.")
@options.workers
@options.scheduler
@options.overwrite
@options.report
def command(
    scene: Path, output: Path, workers: int | None, verbose: bool, quiet: bool, as_json: bool, **settings: Any
) -> None:
    """Simulate what every receiver of SCENE sees of the sky, and store it."""
    from relightcli.stages.precompute import precompute
    from relightcli.stages.precompute_config import Config

    config = Config(
        scene=scene,
        output=output,
        workers=workers or options.available_cores(),
        quiet=quiet or as_json,
        **settings,
    )
    result = precompute(config)
    options.tell(result, _text(result), as_json, quiet)


def _text(result: dict[str, Any]) -> str:
    lines = [f"note: {note}" for note in result["notes"]]
    if result.get("dry_run"):
        for row in result["plan"]:
            cost = row.get("predicted")
            costs = f"{cost['seconds']:.1f} s, {options.bytes_text(cost['bytes'])}" if cost else ""
            lines.append(f"{'simulate' if row['simulate'] else 'skip':9}{row['effect']:12}{costs:18}{row['evidence']}")
        cost = result["predicted"]
        lines.append(
            f"{result['receivers']} receivers; predicted {cost['rays'] / 1e6:.1f} million rays, "
            f"{cost['seconds']:.1f} s, {options.bytes_text(cost['bytes'])}"
        )
    elif result["status"] == "up to date":
        lines.append(f"{result['store']} is up to date")
    else:
        lines.append(
            f"{result['store']}: {result['receivers']} receivers, {result['rays'] / 1e6:.1f} million rays, "
            f"{options.bytes_text(result['bytes'])}, {result['seconds']:.1f} s, "
            f"peak {options.bytes_text(result['peak_bytes'])} per process, {result['wrong_bits']:.1e} of bits wrong"
        )
    return "\n".join(lines)

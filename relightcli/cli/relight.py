"""relightcli relight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="relight")
@click.argument("store", type=options.store_path)
@click.option(
    "-o",
    "--output",
    required=True,
    help="By suffix: .exr .hdr .tif linear, .png .jpg display, .ply vertices, .zarr radiance; - is EXR to stdout.",
)
@click.option("--env", default=None, help="Latitude-longitude map, or the name of an environment of the scene.")
@click.option("--env-rotate", default=0.0, help="Turn the environment about +Y, degrees, right-handed.")
@click.option("--camera", default=None, help="Camera of the scene. Default: its first.")
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="MATERIAL[.PARAMETER]=VALUE",
    help="Change a parameter of a material, or (MATERIAL=NAME) make it a measured one.",
)
@click.option(
    "--pose",
    "poses",
    multiple=True,
    metavar="OBJECT=CLIP@SECONDS",
    help="Pose a skinned object as one of its clips does at a time.",
)
@click.option(
    "--move",
    "moves",
    multiple=True,
    metavar="NAME=NUMBERS",
    help="Put a rigid object or a local light elsewhere: x,y,z; six numbers turn it too; sixteen are its matrix.",
)
@click.option("--frames", default=None, type=options.PATH, help="Keyframes (TOML); output name with ####.")
@click.option("--layers", is_flag=True, help="Write the parts of the picture as EXR layers.")
@click.option(
    "--from",
    "previous",
    default=None,
    type=options.PATH,
    metavar="PREVIOUS",
    help="A radiance store (.zarr) of the same clustered lights: recompute only what has changed since.",
)
@click.option("--background", type=click.Choice(["none", "env"]), default="none", help="What misses show.")
@click.option("--exposure", default=0.0, help="Stops, for display formats.")
@click.option(
    "--basis",
    type=click.Choice(["visibility", "haar", "sh", "dense"]),
    default=None,
    help="How Lambert light is computed. Default: as the store was made.",
)
@click.option("--reference", is_flag=True, help="Path-trace instead; STORE may also be a scene file.")
@click.option("--spp", default=256, type=click.IntRange(1, 1 << 20), show_default=True, help="Samples of --reference.")
@click.option("--bounces", default=None, type=click.IntRange(0, 64), help="Interreflections. Default: the store's.")
@click.option(
    "--suns",
    type=click.Choice(["soft", "traced"]),
    default="soft",
    show_default=True,
    help="Shadows of what moves in the light of small bright places of the sky: by fields, or by rays.",
)
@click.option("--seed", default=0, type=options.SEED, help="Seed of --reference.")
@click.option(
    "--tolerance",
    default=None,
    type=float,
    help="Relative RMS error that is accepted: of the store, as it was measured, or the noise of --reference.",
)
@click.option("--allow-outside", is_flag=True, help="Let a scene file use files outside its folder.")
@click.option("--dry-run", is_flag=True, help="Say what would be written; do nothing.")
@options.workers
@options.scheduler
@options.overwrite
@options.report
def command(
    store: Path,
    workers: int | None,
    background: str,
    verbose: bool,
    quiet: bool,
    as_json: bool,
    **settings: Any,
) -> None:
    """Make pictures from STORE under any sky."""
    from relightcli.stages.relight import Config, relight

    config = Config(
        store=store,
        workers=workers or options.available_cores(),
        background=background == "env",
        quiet=quiet or as_json,
        **settings,
    )
    if as_json and config.output == "-":
        raise click.UsageError("--json and -o - both want stdout")
    result = relight(config)
    if not config.reference:
        options.note_no_blocks(result, config.scheduler)
    options.tell(result, "\n".join([_text(result), *(_steps(result) if verbose else [])]), as_json, quiet)


def _steps(result: dict[str, Any]) -> list[str]:
    """What light of moved things took, step by step."""
    if "moving" not in result:
        return []
    moving = result["moving"]
    lines = [f"  {name}: {1e3 * seconds:.1f} ms a picture" for name, seconds in moving["seconds"].items()]
    hits = f"  {moving['samples']} samples of fields made, {100 * moving['sample_hits']:.1f} % of reads found one made"
    return [*lines, hits, f"  {moving['sun_rays']} rays to suns in the last picture"]


def _text(result: dict[str, Any]) -> str:
    lines = [f"note: {note}" for note in result["notes"]]
    if result.get("dry_run"):
        lines += [f"{f['output']}: {f['environment']} turned by {f['env_rotate']:g} degrees" for f in result["frames"]]
        cost = result["predicted"]
        rays = f"{cost['rays'] / 1e6:.1f} million rays, " if "rays" in cost else ""
        lines.append(f"predicted {rays}{cost['seconds']:.1f} s")
        return "\n".join(lines)
    output = result["output"]
    if result.get("status") == "up to date":
        return "\n".join([*lines, f"{output} is up to date"])
    name = output if isinstance(output, str) else f"{output[0]} .. {output[-1]}"
    if result.get("reference"):
        lines.append(f"{name}: {result['spp']} samples a pixel, {result['seconds']:.1f} s")
    else:
        lines.append(
            f"{name}: {result['seconds']:.2f} s, of which opening {result['open_seconds']:.2f} s, "
            f"lighting {result['lighting_seconds']:.3f} s a frame"
        )
    return "\n".join(lines)

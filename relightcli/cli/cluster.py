"""relightcli cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options


@click.command(name="cluster")
@click.argument("store", type=options.store_path)
@options.output("Clusters store to make, e.g. clusters.zarr.")
@click.option(
    "--clusters", default=None, type=click.IntRange(1, 1 << 20), help="Groups of receivers. Default: one per 1000."
)
@click.option(
    "--tolerance",
    default=None,
    type=float,
    help="Relative RMS of interreflections that the basis for light may leave out. Default: a part of what precompute "
    "has left of its tolerance, else 0.01. Lights: of radiance, all stages together. Default: precompute's, if it had "
    "one.",
)
@click.option("--allow-miss", is_flag=True, help="Lights: make the store even if its error is above the tolerance.")
@click.option(
    "--functions",
    default=4,
    show_default=True,
    type=click.IntRange(1, 16),
    help="Basis functions for the specular lobe of an adjustable material, as light bounces off it.",
)
@click.option(
    "--light-resolution",
    "resolution",
    default=None,
    type=int,
    help="Cluster the lights of the sky instead: texels along a face of its cube, 1 to 4096. Default: 1024 where the "
    "store holds direct light only.",
)
@click.option(
    "--epsilon",
    default=None,
    type=float,
    help="Lights: the error that a cluster may have by its criterion. Default: 0.0425, or 5e-5 for paper.",
)
@click.option(
    "--criterion",
    default="rms",
    show_default=True,
    type=click.Choice(["rms", "paper"]),
    help="Lights: area-weighted RMS of transfer, or the norm over the number of receivers of Johan and Nishita.",
)
@click.option(
    "--lights", default=None, type=int, help="Lights: at most so many clusters; the largest error is split first."
)
@click.option("--seconds", default=None, type=float, help="Lights: refine so long; the largest error is split first.")
@click.option("--camera", default=None, help="Lights: the view for which specular lobes are kept.")
@click.option(
    "--light-factors",
    "light_factors",
    is_flag=True,
    help="Lights: keep what makes a new view of specular lobes a matter of milliseconds, at some percent of error.",
)
@click.option("--seed", default=0, type=options.SEED, show_default=True, help="Seed of samples and first centres.")
@click.option("--dry-run", is_flag=True, help="Say what would be made and what it should cost; do nothing.")
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
    """Group the receivers of the transfer store STORE and find a basis for their light; or, with --light-resolution
    and for stores of direct light, group the lights of the sky."""
    common: dict[str, Any] = {"store": store, "output": output, "workers": workers or options.available_cores()}
    common |= {"quiet": quiet or as_json} | {name: settings[name] for name in ("seed", "dry_run", "overwrite")}
    asked: dict[str, Any] = {name: value for name, value in settings.items() if name in OF_LIGHTS and value is not None}
    if settings["light_factors"]:
        asked["light_factors"] = True
    from relightcli.stages.cluster import Config, cluster, direct_only

    if set(asked) - {"criterion"} or direct_only(store):
        from relightcli.stages.light_clusters import Config as LightConfig
        from relightcli.stages.light_clusters import cluster_lights

        asked |= {name: settings[name] for name in ("tolerance", "allow_miss")}
        result = cluster_lights(LightConfig(**common, **asked, scheduler=scheduler))
        options.tell(result, _light_text(result), as_json, quiet)
        return
    of_receivers: dict[str, Any] = {name: settings[name] for name in ("clusters", "tolerance", "functions")}
    result = cluster(Config(**common, **of_receivers))
    options.note_no_blocks(result, scheduler)
    options.tell(result, "\n".join([*(f"note: {note}" for note in result["notes"]), _text(result)]), as_json, quiet)


OF_LIGHTS = ("resolution", "epsilon", "criterion", "lights", "seconds", "camera")


def _light_text(result: dict[str, Any]) -> str:
    if result.get("dry_run"):
        text = (
            f"{result['receivers']} receivers, {6 * result['resolution'] ** 2} lights in about "
            f"{result['light_clusters']} clusters"
        )
        if "shining_receivers" in result:
            text += f", factors for {result['shining_receivers']} receivers"
        return f"{text}; {options.predicted_text(result)}"
    if result["status"] == "up to date":
        return f"{result['store']} is up to date"
    measured = ""
    if "measured_error" in result:
        measured = f" ({result['measured_error']:.1%} of the radiance under soft lights from anywhere)"
    return (
        f"{result['store']}: {result['lights']} lights in {result['light_clusters']} clusters, RMS error "
        f"{result['error']:.4f} of a light overhead{measured}, {result['rays'] / 1e6:.1f} million rays, "
        f"{options.bytes_text(result['bytes'])}, {result['seconds']:.1f} s"
    )


def _text(result: dict[str, Any]) -> str:
    if result.get("dry_run"):
        return f"{result['receivers']} receivers in {result['clusters']} clusters; {options.predicted_text(result)}"
    if result["status"] == "up to date":
        return f"{result['store']} is up to date"
    return (
        f"{result['store']}: {result['receivers']} receivers in {result['clusters']} clusters, light of rank "
        f"{result['light_rank']} (leaves {result['light_error']:.1%}), {options.bytes_text(result['bytes'])}, "
        f"{result['seconds']:.1f} s"
    )

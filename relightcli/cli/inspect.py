"""relightcli inspect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options
from relightcli.cli.exits import BAD_STORE, OK


@click.command(name="inspect")
@click.argument("store", type=options.store_path)
@click.option("--verify", is_flag=True, help="Read every chunk and check it; exit 3 if anything is wrong.")
@click.option("--picture", default=None, type=options.PATH, help="Draw the clusters of lights into this picture.")
@click.option("--env", default=None, type=options.PATH, help="Of --picture: the map under the clusters' borders.")
@options.report
def command(
    store: Path, verify: bool, picture: Path | None, env: Path | None, as_json: bool, quiet: bool, verbose: bool
) -> int:
    """Show what STORE holds, what it cost, and whether it is sound."""
    import json

    from relightcli.stages.inspect import inspect

    result = inspect(store, verify)
    if picture is not None:
        from relightcli.stages.cluster_picture import draw_clusters

        draw_clusters(store, env, picture)
    if as_json:
        click.echo(json.dumps(result, allow_nan=False))
    elif not quiet:
        click.echo(_text(result))
    return BAD_STORE if result.get("problems") else OK


def _text(result: dict[str, Any]) -> str:
    if not result["complete"]:
        lines = [f"{result['store']}: unfinished {result.get('kind', 'store')}"]
        blocks = result.get("blocks", [])
        lines += [f"  {n}: {value}" for n, value in result.items() if n not in ("store", "complete", "kind", "blocks")]
        lines.append(f"  blocks: {len(blocks)} finished" + (f", last {blocks[-1]['id']}" if blocks else ""))
        return "\n".join(lines)
    size = options.bytes_text
    lines = [
        f"{result['store']}: {result['kind']}, {size(result['bytes'])} ({size(result['raw_bytes'])} uncompressed)",
        f"  made by {result['program']}, {result['created']}",
        "  settings  " + ", ".join(f"{k} {_short(v)}" for k, v in result["settings"].items()),
    ]
    lines += [f"  input     {name}  {digest[:19]}" for name, digest in result["inputs"].items()]
    lines += [
        f"  effect    {row['effect']}: {'simulated' if row['simulate'] else 'skipped'} ({row['evidence']})"
        for row in result["plan"]
    ]
    for before in result["before"]:
        lines += [f"  from {before['kind']}", *_budget(before["rows"])]
    lines += _budget(result["budget"])
    for model in result.get("models", []):
        kind = f"{model['lobes']} lobes" if model["lobes"] else model["model"]
        lines.append(f"  model     visibility of {model['object']} by {kind}")
    for field in result.get("fields", []):
        names = ", ".join(field["objects"]) or "an object"
        lines.append(
            f"  field     of {names}: {size(field['bytes'])}; transfer {field['error']:.2%} off, "
            f"{field['transfer_raw_bytes'] / field['transfer_bytes']:.0f} to 1"
        )
    for name, array in result["arrays"].items():
        shape = " x ".join(str(n) for n in array["shape"])
        lines.append(f"  array     {name:24} {array['dtype']:8} {shape:24} {size(array['bytes'])}")
    if "problems" in result:
        lines += [f"  problem   {problem}" for problem in result["problems"]] or ["  verified: every chunk is sound"]
    return "\n".join(lines)


def _short(value: Any) -> str:
    return ",".join(str(v) for v in value) if isinstance(value, list) else str(value)


def _budget(rows: list[dict[str, Any]]) -> list[str]:
    """What every step cost, and the errors that it knows of."""
    lines = ["  step             seconds   CPU s     Mrays       bytes        peak  error"]
    for row in rows:
        rays = f"{row['rays'] / 1e6:.1f}" if row["rays"] else ""
        size, peak = (options.bytes_text(row[key]) if row[key] else "" for key in ("bytes", "peak_bytes"))
        errors = "; ".join(f"{error['value']:.2g} {error['what']}" for error in row["errors"])
        cells = f"{row['step']:14}{row['seconds']:10.2f}{row['cpu_seconds']:8.2f}{rays:>10}{size:>12}{peak:>12}"
        lines.append(f"    {cells}  {errors}".rstrip())
    return lines

"""relightcli inspect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from relightcli.cli import options
from relightcli.cli.exits import BAD_STORE, OK


@click.command(name="inspect")
@click.argument("store", type=options.PATH)
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
    for effect, cost in result["cost"].items():
        line = f"  cost      {effect}: {cost['blocks']} blocks, {cost.get('seconds', 0.0):.1f} s in workers"
        if "rays" in cost:
            line += f", {cost['rays'] / 1e6:.1f} million rays"
        line += f", peak {size(cost['peak_bytes'])}"
        lines.append(line)
        if "relative_error" in cost:
            lines.append(
                f"  error     {effect}: {cost['relative_error']:.2%} of what vertices see, from "
                f"{int(cost['vertices_checked'])} checks"
            )
        if "wrong_bits" in cost:
            lines.append(
                f"  error     {effect}: {cost['wrong_bits']:.1e} of bits wrong, from {int(cost['checked'])} checks"
            )
    for model in result.get("models", []):
        kind = f"{model['lobes']} lobes" if model["lobes"] else model["model"]
        seen = "" if model["held_out"] is None else f", {model['held_out']['bands']:.1%} at held-out ones"
        lines.append(
            f"  error     visibility of {model['object']} by {kind}: {model['training']['bands']:.1%} at training "
            f"frames{seen}"
        )
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
